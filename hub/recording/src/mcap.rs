//! MCAP files that the hub recorded: each sensor's telegrams, and what the file says about the sensors.

mod catalog;
mod records;

use std::collections::{BTreeMap, HashSet};
use std::io::{self, Read};
use std::sync::Arc;

use scanhub_drivers::features;
use scanhub_drivers::lms::telegram::Telegram;
use scanhub_drivers::lms::variant::Mode;
use schema::datagram::Packed;
use schema::{Family, Foreground, Header, Pace, Scan, Status, Topic};

use crate::{Contents, Damage, Form, Frame, MountRecord};
pub(crate) use catalog::Catalog;
use catalog::Place;
use records::Records;
pub(crate) use records::{Record, has_border};

/// A part of a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Item {
    /// A telegram of a sensor.
    Telegram(Sample),
    /// Any other record.
    Record(Record),
}

/// A message of topic `telegram`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Sample {
    pub(crate) sensor: String,
    pub(crate) header: Header,
    pub(crate) telegram: Vec<u8>,
}

/// Reads a file from its beginning to its end.
pub(crate) struct Reader<R> {
    records: Records<R>,
    catalog: Catalog,
    /// Whether messages were read whose channel was not known yet.
    has_unknown: bool,
}

impl<R: Read> Reader<R> {
    /// Reads `input`, about which `catalog` is known already.
    fn new(input: R, catalog: Catalog) -> Self {
        Reader { records: Records::new(input), catalog, has_unknown: false }
    }

    /// Returns the next telegram or record; `None` at the end.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Records::next`] and [`Catalog::note`].
    pub(crate) fn next(&mut self) -> io::Result<Option<Item>> {
        loop {
            let Some(record) = self.records.next()? else { return Ok(None) };
            self.catalog.note(&record)?;
            let sample = self.telegram(&record);
            if !record.is_in_chunk && self.is_damaged(&record, sample.as_ref()) {
                self.records.reject(&record);
                continue;
            }
            return Ok(Some(match sample {
                Some(sample) => Item::Telegram(sample),
                None => Item::Record(record),
            }));
        }
    }

    /// Returns whether a record that no checksum of a chunk covers contradicts itself: a message of the hub whose header does
    /// not fit to it, or a telegram of an LMS with a wrong CRC.
    fn is_damaged(&self, record: &Record, sample: Option<&Sample>) -> bool {
        if let Some(Sample { header, telegram, .. }) = sample {
            return header.family == Family::Lms as u8 && Telegram::check(telegram).is_none();
        }
        record.message().is_some_and(|(message, data)| {
            let is_ours = matches!(self.catalog.place(message.channel_id), Some(Some(_)));
            is_ours && catalog::sample(&message, data).is_none()
        })
    }

    fn telegram(&mut self, record: &Record) -> Option<Sample> {
        let (message, data) = record.message()?;
        let (sensor, (header, telegram)) = match self.catalog.place(message.channel_id) {
            Some(place) => {
                let place = place.filter(|place| place.topic == Topic::Telegram)?;
                (place.sensor.clone(), catalog::sample(&message, data)?)
            }
            // The channel's record is lost. A telegram of an LMS shows by itself that it is one.
            None => {
                self.has_unknown = true;
                let sample = catalog::sample(&message, data)?;
                Telegram::check(sample.1)?;
                (format!("sensor{}", sample.0.sensor), sample)
            }
        };
        Some(Sample { sensor, header, telegram: telegram.to_vec() })
    }
}

/// Contents of a file that was read to its end.
#[derive(Debug)]
pub(crate) struct Survey {
    whole: Contents,
    sensors: BTreeMap<String, Contents>,
    catalog: Catalog,
    /// Header of each sensor's last telegram.
    last: BTreeMap<String, Header>,
    /// Number of the first telegram that the hub processed further, by sensor and run of the hub.
    understood: BTreeMap<String, BTreeMap<u64, u64>>,
    /// Number of pairs of sensor and run in it.
    runs: usize,
}

impl Default for Survey {
    fn default() -> Self {
        Survey {
            whole: Contents::new(Form::Mcap),
            sensors: BTreeMap::new(),
            catalog: Catalog::default(),
            last: BTreeMap::new(),
            understood: BTreeMap::new(),
            runs: 0,
        }
    }
}

impl Survey {
    /// Reads the file that `open` opens. A damaged file may be read twice, because its index can name channels whose first
    /// chunk is lost.
    ///
    /// # Errors
    ///
    /// Returns the errors of `open` and of [`Reader::next`].
    pub(crate) fn of<R: Read>(open: impl Fn() -> io::Result<R>) -> io::Result<Survey> {
        let (survey, is_complete) = Survey::read(Reader::new(open()?, Catalog::default()))?;
        if is_complete {
            return Ok(survey);
        }
        Survey::read(Reader::new(open()?, survey.catalog)).map(|(survey, _)| survey)
    }

    /// Reads a file, and returns whether all of its messages have known channels.
    fn read<R: Read>(mut reader: Reader<R>) -> io::Result<(Survey, bool)> {
        let mut survey = Survey::default();
        while let Some(item) = reader.next()? {
            match item {
                Item::Telegram(sample) => survey.note(&sample),
                Item::Record(record) => survey.note_record(&reader.catalog, &record),
            }
        }
        survey.whole.sensors = reader.catalog.sensors();
        for sensor in &survey.whole.sensors {
            of_sensor(&mut survey.sensors, sensor);
        }
        let named: HashSet<_> = survey.whole.sensors.iter().collect();
        let nameless: Vec<_> = survey.sensors.keys().filter(|name| !named.contains(name)).cloned().collect();
        survey.whole.sensors.extend(nameless);
        let damage = reader.records.damage();
        for contents in std::iter::once(&mut survey.whole).chain(survey.sensors.values_mut()) {
            contents.damage = Damage { telegrams: contents.damage.telegrams, ..damage };
        }
        survey.catalog = reader.catalog;
        Ok((survey, !reader.has_unknown))
    }

    /// Returns the contents of the whole file.
    pub(crate) fn contents(&self) -> Contents {
        self.whole.clone()
    }

    /// Returns the contents that belong to `sensor`.
    pub(crate) fn contents_of(&self, sensor: &str) -> Contents {
        let contents = self.sensors.get(sensor).cloned().unwrap_or(Contents::new(Form::Mcap));
        Contents { sensors: vec![sensor.to_owned()], ..contents }
    }

    /// Reads the file again, from `input`.
    pub(crate) fn reader<R: Read>(&self, input: R) -> Reader<R> {
        Reader::new(input, self.catalog.clone())
    }

    /// Returns the channels of the file.
    pub(crate) fn catalog(&self) -> &Catalog {
        &self.catalog
    }

    /// Returns the number of the first telegram of `sensor` that the hub with this `boot` processed further; `None` if the
    /// file does not contain it, or is damaged.
    pub(crate) fn understood(&self, sensor: &str, boot: u64) -> Option<u64> {
        self.understood.get(sensor)?.get(&boot).copied().filter(|_| !self.whole.damage.is_harmed)
    }

    fn note(&mut self, sample: &Sample) {
        let Sample { sensor, header, telegram } = sample;
        let missing = match self.last.get_mut(sensor) {
            Some(last) => {
                let last = std::mem::replace(last, *header);
                let is_same_run = last.boot == header.boot;
                if is_same_run {
                    header.topic_seq.saturating_sub(last.topic_seq.saturating_add(1))
                } else {
                    0
                }
            }
            None => {
                self.last.insert(sensor.clone(), *header);
                0
            }
        };
        for contents in [&mut self.whole, of_sensor(&mut self.sensors, sensor)] {
            contents.note(header.family, telegram, Some(header.wall_ns));
            contents.damage.telegrams = contents.damage.telegrams.saturating_add(missing);
        }
    }

    /// Takes over what statuses say about the scanner, and which telegrams the hub processed further.
    fn note_record(&mut self, catalog: &Catalog, record: &Record) {
        let Some((place, header, payload)) = catalog.message(record) else { return };
        let is_of_scan = place.topic.row().pace == Pace::Scan && place.topic != Topic::Telegram;
        // A sample without a hub time was not caused by a telegram.
        if is_of_scan && header.hub_time_ns().is_some() {
            let runs = match self.understood.get_mut(&place.sensor) {
                Some(runs) => runs,
                None => self.understood.entry(place.sensor.clone()).or_default(),
            };
            match runs.get_mut(&header.boot) {
                Some(first) => *first = header.seq.min(*first),
                None if self.runs < MOST_RUNS => {
                    runs.insert(header.boot, header.seq);
                    self.runs += 1;
                }
                None => {}
            }
        }
        if header.family != Family::Lms as u8 {
            let of_sensor = of_sensor(&mut self.sensors, &place.sensor);
            if of_sensor.beams.is_none() {
                of_sensor.beams = beams_of(place, payload);
                self.whole.beams = self.whole.beams.or(of_sensor.beams);
            }
        }
        let mut status = Status::default();
        if place.topic == Topic::Status && status.unpack(payload) {
            let mode = (status.mode != Status::MODE_UNKNOWN).then_some(Mode(status.mode));
            let rotating = if place.is_old { None } else { rotating(&status) };
            let name = Some(status.sensor_type()).filter(|name| !name.is_empty());
            for contents in [&mut self.whole, of_sensor(&mut self.sensors, &place.sensor)] {
                contents.mode = contents.mode.or(mode);
                if contents.sensor_type.is_none() {
                    contents.sensor_type = name.map(|name| (status.family, name.to_owned()));
                }
                if let Some((model, way)) = rotating {
                    contents.model = contents.model.or(model);
                    contents.way = contents.way.or(way);
                    contents.step_cdeg = contents.step_cdeg.or(Some(status.resolution_cdeg));
                }
            }
        }
    }
}

/// Returns the number of beams of the scan that `payload` is, or that it was computed from. `None` for another topic.
fn beams_of(place: &Place, payload: &[u8]) -> Option<u16> {
    match place.topic {
        _ if place.is_old => None,
        Topic::Scan => {
            let mut scan = Box::<Scan>::default();
            Scan::unpack_into(&mut scan, payload).then(|| scan.beams() as u16)
        }
        // The default topics of a recording contain no scans.
        Topic::Foreground => {
            let mut foreground = Box::<Foreground>::default();
            Foreground::unpack_into(&mut foreground, payload).then_some(foreground.count)
        }
        _ => None,
    }
    .filter(|beams| *beams > 0)
}

/// Returns the model and the scan mode that `status` names, if the scanner is a rotating one. Each is `None` if this version
/// does not know it.
fn rotating(status: &Status) -> Option<(Option<&'static str>, Option<&'static str>)> {
    let features = features(Family::of_number(status.family)?);
    let name = status.model().filter(|_| !features.has_whole_telegrams)?;
    let model = features.models.iter().map(|model| model.name).find(|known| *known == name);
    let way = features.modes.iter().copied().find(|known| status.way() == Some(known));
    Some((model, way))
}

fn of_sensor<'a>(sensors: &'a mut BTreeMap<String, Contents>, sensor: &str) -> &'a mut Contents {
    sensors.entry(sensor.to_owned()).or_insert(Contents::new(Form::Mcap))
}

/// The telegrams of one sensor, in the order of the file.
pub(crate) struct Frames<R> {
    reader: Reader<R>,
    sensor: String,
}

impl<R: Read> Frames<R> {
    pub(crate) fn new(input: R, survey: &Arc<Survey>, sensor: String) -> Self {
        Frames { reader: survey.reader(input), sensor }
    }
}

impl<R: Read> Iterator for Frames<R> {
    type Item = Frame;

    fn next(&mut self) -> Option<Frame> {
        loop {
            if let Item::Telegram(Sample { sensor, header, telegram }) = self.reader.next().ok()??
                && sensor == self.sensor
            {
                return Some(Frame {
                    telegram,
                    family: header.family,
                    wall_ns: Some(header.wall_ns),
                    scanner_ns: None,
                    reasons: header.reasons,
                    header: Some(header),
                });
            }
        }
    }
}

/// The angles of one mount and the telegrams of its machine, in the order of the file.
pub(crate) struct Angles<R> {
    reader: Reader<R>,
    mount: String,
    /// Whether the recording has no sensor of the mount's machine. Then the telegrams of all machines count.
    is_alone: bool,
}

impl<R: Read> Angles<R> {
    pub(crate) fn new(input: R, survey: &Arc<Survey>, mount: String) -> Self {
        let is_near = |sensor: &String| machine(sensor) == machine(&mount);
        let is_alone = !survey.catalog().sensors().iter().any(is_near);
        Angles { reader: survey.reader(input), mount, is_alone }
    }
}

impl<R: Read> Iterator for Angles<R> {
    type Item = MountRecord;

    fn next(&mut self) -> Option<MountRecord> {
        loop {
            match self.reader.next().ok()?? {
                Item::Record(record) => {
                    if let Some((header, tilt)) = self.reader.catalog.angle(&record, &self.mount) {
                        return Some(MountRecord::Angle(header, tilt));
                    }
                }
                Item::Telegram(Sample { sensor, header, .. }) => {
                    if self.is_alone || machine(&sensor) == machine(&self.mount) {
                        return Some(MountRecord::Telegram(header));
                    }
                }
            }
        }
    }
}

/// Returns the machine in the name of a remote sensor; `None` for a sensor of this machine.
fn machine(sensor: &str) -> Option<&str> {
    sensor.split_once('.').map(|(machine, _)| machine)
}

/// Maximum number of runs of a hub that are remembered: one per minute for a month.
const MOST_RUNS: usize = 50_000;
