//! Recordings of the hub: what an MCAP file contains about each sensor, and its telegrams. Refuses to know how samples
//! were written, and what other programs have added.

mod channels;
mod chunk;
mod exact;
mod headless;
mod knowledge;
mod originals;
pub(crate) mod reader;
mod records;
mod salvage;
mod seen;
mod source;
mod window;

use std::collections::{BTreeMap, HashSet};
use std::io::{self, Read};
use std::sync::Arc;

use lms::variant::Mode;
use schema::datagram::Packed;
use schema::{Family, Header, Pace, Scan, Status, Topic};

use crate::open::is_end;
use crate::{Contents, Damage, Form, Frame};
pub(crate) use exact::parse;
pub(crate) use headless::is_mcap;
use knowledge::MOST_LIVES;
pub(crate) use knowledge::{Knowledge, message};
pub(crate) use originals::Originals;
use reader::{Item, Reader, Sighting};
pub(crate) use records::Record;
use source::Source;

/// What is known of a file that was read through.
#[derive(Debug)]
pub(crate) struct Survey {
    whole: Contents,
    sensors: BTreeMap<String, Contents>,
    knowledge: Knowledge,
    is_sound: bool,
    numbers: BTreeMap<String, Numbers>,
    /// Number of the first telegram of which a hub made something, by sensor and life.
    understood: BTreeMap<String, BTreeMap<u64, u64>>,
    /// Pairs of sensor and life in it.
    lives: usize,
}

/// The last telegram of a sensor whose number is known.
#[derive(Clone, Copy, Debug, Default)]
struct Numbers {
    last: Option<Header>,
    /// Telegrams after it whose numbers are not.
    estimated: u64,
}

impl Default for Survey {
    fn default() -> Self {
        Survey {
            whole: Contents::new(Form::Mcap),
            sensors: BTreeMap::new(),
            knowledge: Knowledge::default(),
            is_sound: true,
            numbers: BTreeMap::new(),
            understood: BTreeMap::new(),
            lives: 0,
        }
    }
}

impl Survey {
    /// Reads the file that `open` opens through: once if it is sound.
    ///
    /// `is_headless`: its beginning is missing.
    pub(crate) fn of<R: Read>(open: impl Fn() -> io::Result<R>, is_headless: bool) -> io::Result<Survey> {
        let failed = match Survey::read(Reader::sound(open()?)) {
            Err(error) if is_end(&error) => error,
            other => return other,
        };
        let knowledge = Knowledge::of(Source::of(open()?, false))?;
        let mut survey = Survey::read(Reader::harmed(open()?, knowledge))?;
        survey.is_sound = false;
        let is_cut = failed.kind() == io::ErrorKind::UnexpectedEof && survey.whole.damage.is_cut;
        survey.tell(|damage| (damage.is_headless, damage.is_harmed) = (is_headless, !is_cut));
        Ok(survey)
    }

    fn read<R: Read>(mut reader: Reader<R>) -> io::Result<Survey> {
        let mut survey = Survey::default();
        while let Some(item) = reader.next()? {
            match item {
                Item::Telegram(sighting) => survey.note(&sighting),
                Item::Record(record) => survey.note_record(&reader.knowledge, &record),
            }
        }
        survey.whole.sensors = reader.knowledge.channels.sensors();
        for sensor in &survey.whole.sensors {
            of_sensor(&mut survey.sensors, sensor);
        }
        // Those whose names are lost.
        let named: HashSet<_> = survey.whole.sensors.iter().collect();
        let others = survey.sensors.keys().filter(|name| !named.contains(name));
        let others: Vec<_> = others.cloned().collect();
        survey.whole.sensors.extend(others);
        if let Some(account) = reader.account() {
            survey.tell(|damage| {
                (damage.bytes, damage.chunks) = (account.passed, account.chunks);
                damage.is_cut = !account.has_end;
            });
        }
        survey.knowledge = reader.knowledge;
        Ok(survey)
    }

    /// What is in the file.
    pub(crate) fn contents(&self) -> Contents {
        self.whole.clone()
    }

    /// What is in it of `sensor`.
    pub(crate) fn contents_of(&self, sensor: &str) -> Contents {
        let contents = self.sensors.get(sensor).cloned().unwrap_or(Contents::new(Form::Mcap));
        Contents { sensors: vec![sensor.to_owned()], ..contents }
    }

    /// All that is in the file, as `input` has it.
    pub(crate) fn reader<R: Read>(&self, input: R) -> Reader<R> {
        if self.is_sound { Reader::sound(input) } else { Reader::harmed(input, self.knowledge.clone()) }
    }

    /// What the file says beside its telegrams.
    pub(crate) fn knowledge(&self) -> &Knowledge {
        &self.knowledge
    }

    /// Number of the first telegram of `sensor` of which the hub with this `boot` made something. Nothing if that is in
    /// no file, or in one that is harmed.
    pub(crate) fn understood(&self, sensor: &str, boot: u64) -> Option<u64> {
        self.understood.get(sensor)?.get(&boot).copied().filter(|_| !self.whole.damage.is_harmed)
    }

    /// Says of the whole file and of each sensor what `tell` says.
    fn tell(&mut self, tell: impl Fn(&mut Damage)) {
        tell(&mut self.whole.damage);
        self.sensors.values_mut().for_each(|contents| tell(&mut contents.damage));
    }

    fn note(&mut self, sighting: &Sighting) {
        let numbers = self.numbers.entry(sighting.sensor.clone()).or_default();
        let mut missing = 0;
        if sighting.is_estimated {
            numbers.estimated += 1;
        } else {
            let header = sighting.header;
            if let Some(last) = numbers.last.filter(|last| last.boot == header.boot) {
                missing =
                    header.topic_seq.saturating_sub(last.topic_seq.saturating_add(1 + numbers.estimated));
            }
            *numbers = Numbers { last: Some(header), estimated: 0 };
        }
        for contents in [&mut self.whole, of_sensor(&mut self.sensors, &sighting.sensor)] {
            contents.note(sighting.header.family, &sighting.telegram, Some(sighting.header.wall_ns));
            contents.damage.telegrams = contents.damage.telegrams.saturating_add(missing);
            contents.damage.estimated += u64::from(sighting.is_estimated);
        }
    }

    /// The measuring mode stands in a status too; what was made of a scan says that it was known by then.
    fn note_record(&mut self, knowledge: &Knowledge, record: &Record) {
        let Some((place, header, payload)) = knowledge.message(record) else { return };
        let is_of_scan = place.topic.row().pace == Pace::Scan && place.topic != Topic::Telegram;
        // What is said without a telegram was not sent after one.
        if is_of_scan && header.hub_time_ns().is_some() {
            let lives = match self.understood.get_mut(&place.sensor) {
                Some(lives) => lives,
                None => self.understood.entry(place.sensor.clone()).or_default(),
            };
            match lives.get_mut(&header.boot) {
                Some(first) => *first = header.seq.min(*first),
                None if self.lives < MOST_LIVES => {
                    lives.insert(header.boot, header.seq);
                    self.lives += 1;
                }
                None => {}
            }
        }
        if place.has_scans() && header.family != Family::Lms as u8 {
            let of_sensor = of_sensor(&mut self.sensors, &place.sensor);
            let mut scan = Box::<Scan>::default();
            if of_sensor.beams.is_none() && Scan::unpack_into(&mut scan, payload) {
                of_sensor.beams = Some(scan.beams() as u16);
                self.whole.beams = self.whole.beams.or(of_sensor.beams);
            }
        }
        let mut status = Status::default();
        if place.topic == Topic::Status && status.unpack(payload) {
            let mode = (status.mode != Status::MODE_UNKNOWN).then_some(Mode(status.mode));
            let told = if place.is_old() { None } else { told(&status) };
            for contents in [&mut self.whole, of_sensor(&mut self.sensors, &place.sensor)] {
                contents.mode = contents.mode.or(mode);
                if let Some((model, way)) = told {
                    contents.model = contents.model.or(Some(model));
                    contents.way = contents.way.or(way);
                    contents.step_cdeg = contents.step_cdeg.or(Some(status.resolution_cdeg));
                }
            }
        }
    }
}

/// The names of the model and of the way of measuring that `status` tells, of a scanner whose head turns.
fn told(status: &Status) -> Option<(&'static str, Option<&'static str>)> {
    let features = scanner::features(Family::of_number(status.family)?)?;
    let name = status.model()?;
    let model = features.models.iter().map(|model| model.name).find(|known| *known == name)?;
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
            if let Item::Telegram(Sighting { sensor, header, telegram, .. }) = self.reader.next().ok()??
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
