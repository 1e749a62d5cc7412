//! What a file says of itself beside its telegrams, as far as checksums vouch for it: channels, numbers of sensors,
//! lives of the hub. With it is judged what no checksum vouches for. Refuses to know where telegrams come from.

use std::collections::BTreeMap;
use std::io::{self, Read};

use mcap::parse_record;
use mcap::records::{MessageHeader, Record as Parsed, op};
use schema::{Header, Quality, Topic, file};

use super::channels::{Channels, Place};
use super::exact::{self, MESSAGE, head_of_message};
use super::originals::Originals;
use super::records::Record;
use super::salvage::{Found, Lone};
use super::source::Source;

/// What is known of a file.
#[derive(Clone, Debug, Default)]
pub(crate) struct Knowledge {
    pub(crate) channels: Channels,
    pub(crate) originals: Originals,
    /// From the hub's monotonic clock to the wall clock, by its lives.
    lives: BTreeMap<u64, i128>,
    /// Header of the first message that is proven, by channels. What they are may be told at the end of the file.
    first: BTreeMap<u16, Header>,
}

impl Knowledge {
    /// Learns from all that `source` has.
    pub(crate) fn of<R: Read>(mut source: Source<R>) -> io::Result<Knowledge> {
        let mut knowledge = Knowledge::default();
        while let Some(found) = source.next()? {
            knowledge.note(&found);
        }
        Ok(knowledge)
    }

    /// Takes over what `found` says.
    pub(crate) fn note(&mut self, found: &Found) {
        let (record, is_proven) = match found {
            Found::Proven(record) => (record, true),
            Found::Likely(record) => (record, false),
            Found::Lone(_) => return,
        };
        if record.opcode != op::MESSAGE {
            self.originals.note(record, is_proven);
        }
        if record.opcode == op::CHANNEL && exact::fills(record) {
            if let Ok(Parsed::Channel(channel)) = parse_record(record.opcode, &record.body) {
                self.channels.note(&channel, is_proven);
            }
        } else if let Some((head, data)) = message(record) {
            self.note_message(&head, data);
        }
    }

    fn note_message(&mut self, message: &MessageHeader, data: &[u8]) {
        // A channel of somebody else's has other bytes there.
        if let Some((header, _)) = file::parts(data).filter(|(header, _)| fits(header, message)) {
            self.lives.entry(header.boot).or_insert_with(|| offset(&header));
            self.first.entry(message.channel_id).or_insert(header);
        }
    }

    /// The sensor that a message of channel `id` is of, whose header says `number`.
    pub(crate) fn sensor(&self, id: Option<u16>, number: u8) -> Option<&str> {
        let place = id.and_then(|id| self.channels.place(id)?).filter(|place| place.topic == Topic::Telegram);
        let named = || self.firsts().find(|(_, first)| first.sensor == number).map(|(place, _)| place);
        place.or_else(named).map(|place| &place.sensor[..])
    }

    /// The header before `lone`, a telegram of `sensor`, unless it contradicts its message, the sensor or the clocks.
    pub(crate) fn header(&self, lone: &Lone, sensor: &str) -> Option<Header> {
        let (header, _) = file::parts(&lone.header)?;
        let fits_message = lone.message.is_none_or(|message| fits(&header, &message));
        let number = self.firsts().find(|(place, _)| place.sensor == sensor).map(|(_, first)| first.sensor);
        let took_ns = header.stamp_last_ns.checked_sub(header.stamp_first_ns)?;
        let fits_life = match self.lives.get(&header.boot) {
            Some(known) => known.abs_diff(offset(&header)) < STEPPED_NS,
            None => self.lives.is_empty() && lone.message.is_some(),
        };
        let is_sound = number.is_none_or(|number| number == header.sensor)
            && header.quality <= Quality::Suspect as u8
            && took_ns < LONGEST_NS
            && header.seq.abs_diff(header.topic_seq) < MOST_APART;
        (fits_message && fits_life && is_sound).then_some(header)
    }

    /// The header that a telegram of `sensor` had at the earliest.
    pub(crate) fn first(&self, sensor: &str) -> Option<Header> {
        self.firsts().find(|(place, _)| place.sensor == sensor).map(|(_, first)| *first)
    }

    /// The first header of each of the hub's channels, telegrams before all else.
    fn firsts(&self) -> impl Iterator<Item = (&Place, &Header)> {
        let of = |id: &u16| self.channels.place(*id).flatten();
        let all = move || self.first.iter().filter_map(move |(id, header)| Some((of(id)?, header)));
        let is_telegram = |(place, _): &(&Place, &Header)| place.topic == Topic::Telegram;
        all().filter(is_telegram).chain(all().filter(move |first| !is_telegram(first)))
    }

    /// What the message in `record` is, and its header, if it is one of the hub's.
    pub(crate) fn message<'a>(&self, record: &'a Record) -> Option<(&Place, Header, &'a [u8])> {
        let (message, data) = message(record)?;
        let (header, payload) = file::parts(data)?;
        Some((self.channels.place(message.channel_id)??, header, payload))
    }
}

/// Head and data of the message that `record` is.
pub(crate) fn message(record: &Record) -> Option<(MessageHeader, &[u8])> {
    let body = Some(&record.body).filter(|_| record.opcode == op::MESSAGE)?;
    Some((head_of_message(body)?, &body[MESSAGE..]))
}

/// Whether `header` says what the head of its message says.
pub(crate) fn fits(header: &Header, message: &MessageHeader) -> bool {
    (header.topic_seq as u32, header.wall_ns) == (message.sequence, message.log_time)
}

fn offset(header: &Header) -> i128 {
    i128::from(header.wall_ns) - i128::from(header.stamp_first_ns)
}

/// Telegrams take no longer.
const LONGEST_NS: u64 = 10_000_000_000;
/// The wall clock is not set by more in a life of the hub, or was not right before.
const STEPPED_NS: u128 = 3_600_000_000_000;
/// Number of a telegram and number of its sample, which are the same unless a sample could not be sent.
const MOST_APART: u64 = 1 << 20;
