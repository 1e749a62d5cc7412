//! A file's telegrams, each with its sensor and its header, among everything else in the file. In a damaged file, a header
//! that cannot be right is replaced by an estimate, and a telegram that occurs twice is used once. Refuses to know how
//! telegrams are used.

use std::collections::BTreeMap;
use std::io::{self, Read};

use lms::telegram::Telegram;
use schema::{Flags, Header, Topic, file};

use super::knowledge::{Knowledge, fits, message};
use super::records::Record;
use super::salvage::{Account, Found, HEADER, Lone};
use super::seen::Seen;
use super::source::Source;

/// What is in a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Item {
    /// A telegram.
    Telegram(Sighting),
    /// Any other record.
    Record(Record),
}

/// A telegram of a sensor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Sighting {
    pub(crate) sensor: String,
    pub(crate) header: Header,
    pub(crate) telegram: Vec<u8>,
    /// The header is a guess.
    pub(crate) is_estimated: bool,
}

/// Reads a file through.
pub(crate) struct Reader<R> {
    source: Source<R>,
    pub(crate) knowledge: Knowledge,
    seen: Seen,
    /// Header that was given last, by sensor.
    last: BTreeMap<String, Header>,
    /// Sensor of the telegram before.
    neighbour: Option<String>,
}

impl<R: Read> Reader<R> {
    /// Reads a sound file, and learns from it.
    pub(crate) fn sound(input: R) -> Self {
        Reader::new(Source::of(input, true), Knowledge::default())
    }

    /// Searches a file that is harmed, of which `knowledge` is had.
    pub(crate) fn harmed(input: R, knowledge: Knowledge) -> Self {
        Reader::new(Source::of(input, false), knowledge)
    }

    fn new(source: Source<R>, knowledge: Knowledge) -> Self {
        Reader { source, knowledge, seen: Seen::default(), last: BTreeMap::new(), neighbour: None }
    }

    /// What belongs to nothing, of a file that is searched.
    pub(crate) fn account(&self) -> Option<Account> {
        self.source.account()
    }

    /// What comes next; errors as of [`Source::next`].
    pub(crate) fn next(&mut self) -> io::Result<Option<Item>> {
        while let Some(found) = self.source.next()? {
            if matches!(self.source, Source::Sound(_)) {
                self.knowledge.note(&found);
                self.knowledge.check()?;
            }
            let sighting = match found {
                Found::Lone(lone) => self.judge(lone),
                Found::Likely(record) => return Ok(Some(Item::Record(record))),
                Found::Proven(record) => match self.telegram(&record) {
                    Some(sighting) => self.once(&record, sighting),
                    None => return Ok(Some(Item::Record(record))),
                },
            };
            if let Some(sighting) = sighting {
                self.last.insert(sighting.sensor.clone(), sighting.header);
                self.neighbour = Some(sighting.sensor.clone());
                return Ok(Some(Item::Telegram(sighting)));
            }
        }
        Ok(None)
    }

    /// The telegram in a record that is proven.
    fn telegram(&self, record: &Record) -> Option<Sighting> {
        let (head, data) = message(record)?;
        let (header, telegram) = file::parts(data)?;
        let is_telegram = match self.knowledge.channels.place(head.channel_id) {
            Some(place) => place?.topic == Topic::Telegram,
            // Its channel's record is lost.
            None => Telegram::check(telegram).is_some(),
        };
        if !is_telegram {
            return None;
        }
        let sensor = self.sensor(Some(head.channel_id), header.sensor, true);
        Some(Sighting { sensor, header, telegram: telegram.to_vec(), is_estimated: false })
    }

    /// `sighting`, which is what `record` is, unless it was there before.
    fn once(&mut self, record: &Record, sighting: Sighting) -> Option<Sighting> {
        if matches!(self.source, Source::Sound(_)) {
            return Some(sighting);
        }
        let (_, data) = message(record)?;
        let header = data.first_chunk()?;
        self.novelty(header, &sighting.telegram).0.then_some(sighting)
    }

    /// Whether `telegram` was not there before with this header, and not with its last fields.
    fn novelty(&mut self, header: &[u8; HEADER], telegram: &[u8]) -> (bool, bool) {
        (self.seen.is_new(header, telegram), self.seen.is_new(&header[TAIL..], telegram))
    }

    /// What is to be thought of a telegram among harmed bytes.
    fn judge(&mut self, lone: Lone) -> Option<Sighting> {
        let id = lone.message.map(|message| message.channel_id);
        let said = file::parts(&lone.header).zip(lone.message);
        let is_agreed = said.is_some_and(|((header, _), message)| fits(&header, &message));
        let sensor = self.sensor(id, lone.header[SENSOR], is_agreed);
        let sound = self.knowledge.header(&lone, &sensor);
        let (is_whole_new, is_tail_new) = self.novelty(&lone.header, &lone.telegram);
        // A message that is not whole may be the end of one that was there before.
        let is_relied_on = sound.is_some() && lone.message.is_some();
        if !is_whole_new || !is_relied_on && !is_tail_new {
            return None;
        }
        let header = sound.unwrap_or_else(|| self.estimate(&lone, &sensor));
        Some(Sighting { sensor, header, telegram: lone.telegram, is_estimated: sound.is_none() })
    }

    /// By the channel, else by the number, else, unless the number `is_right`, that of the telegram before. One whose name
    /// is lost is called by its number.
    fn sensor(&self, id: Option<u16>, number: u8, is_right: bool) -> String {
        if let Some(sensor) = self.knowledge.sensor(id, number) {
            return sensor.to_owned();
        }
        let first = self.knowledge.channels.first_sensor();
        let near = self.neighbour.as_deref().or(first).filter(|_| !is_right && first.is_some());
        near.map_or_else(|| format!("sensor{number}"), str::to_owned)
    }

    /// A header after the one before: times of the message, else a period later.
    fn estimate(&self, lone: &Lone, sensor: &str) -> Header {
        let before = self.last.get(sensor).copied();
        let known = before.or_else(|| self.knowledge.first(sensor)).unwrap_or_default();
        let step_ns = if before.is_some() { u64::from(known.period_us) * 1000 } else { 0 };
        let told = lone.message.map(|m| m.log_time).filter(|at| at.abs_diff(known.wall_ns) < FAR_NS);
        let wall_ns = told.unwrap_or(known.wall_ns.saturating_add(step_ns));
        let monotonic = |stamp_ns: u64| stamp_ns.saturating_add(wall_ns).saturating_sub(known.wall_ns);
        let number = |last: u64| last.saturating_add(u64::from(before.is_some()));
        Header {
            seq: number(known.seq),
            topic_seq: number(known.topic_seq),
            stamp_first_ns: monotonic(known.stamp_first_ns),
            stamp_last_ns: monotonic(known.stamp_last_ns),
            wall_ns,
            quality: 0,
            reasons: 0,
            hub_time: [0; 3],
            flags: known.flags | Flags::STAMP_ESTIMATED,
            ..known
        }
    }
}

/// Where a header has the number of its sensor.
const SENSOR: usize = 48;
/// Where its last fields begin, reasons and time in the hub, which two telegrams that are alike seldom share.
const TAIL: usize = 60;
/// Times of messages that are so far from the telegram before are not believed.
const FAR_NS: u64 = 3_600_000_000_000;
