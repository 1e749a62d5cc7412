//! What a file says about itself besides its telegrams, as far as checksums confirm it: channels, numbers of sensors,
//! runs of the hub. Data without a checksum is checked against it. Refuses to know where telegrams come from.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::io::{self, Read};

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
    /// Channel of the first of those headers, by numbers of sensors and by their names.
    numbers: BTreeMap<u8, Rank>,
    names: BTreeMap<String, Rank>,
}

/// Which of several channels of a sensor is asked: of telegrams before all else (`false` is less), then by numbers.
type Rank = (bool, u16);

impl Knowledge {
    /// Learns from all that `source` has.
    pub(crate) fn of<R: Read>(mut source: Source<R>) -> io::Result<Knowledge> {
        let mut knowledge = Knowledge::default();
        while let Some(found) = source.next()? {
            knowledge.note(&found);
            knowledge.check()?;
        }
        // What a channel is may have been told otherwise before.
        knowledge.numbers.clear();
        knowledge.names.clear();
        let ids: Vec<u16> = knowledge.first.keys().copied().collect();
        ids.into_iter().for_each(|id| knowledge.list(id));
        Ok(knowledge)
    }

    /// [`io::ErrorKind::FileTooLarge`] if the file says more than is kept.
    pub(crate) fn check(&self) -> io::Result<()> {
        self.channels.check().and_then(|()| self.originals.check())
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
        if record.opcode == op::CHANNEL {
            if let Some(Parsed::Channel(channel)) = exact::parse(record) {
                self.channels.note(&channel, is_proven);
                self.list(channel.id);
            }
        } else if let Some((head, data)) = message(record) {
            self.note_message(&head, data);
        }
    }

    fn note_message(&mut self, message: &MessageHeader, data: &[u8]) {
        // A channel of somebody else's has other bytes there.
        if let Some((header, _)) = file::parts(data).filter(|(header, _)| fits(header, message)) {
            if self.lives.len() < MOST_LIVES {
                self.lives.entry(header.boot).or_insert_with(|| offset(&header));
            }
            if let Entry::Vacant(first) = self.first.entry(message.channel_id) {
                first.insert(header);
                self.list(message.channel_id);
            }
        }
    }

    /// Lists the channel with number `id` by its sensor, if both that and a header are known.
    fn list(&mut self, id: u16) {
        if let (Some(place), Some(header)) = (self.channels.place(id).flatten(), self.first.get(&id)) {
            let rank = (place.topic != Topic::Telegram, id);
            let listed = self.numbers.entry(header.sensor).or_insert(rank);
            *listed = rank.min(*listed);
            match self.names.get_mut(&place.sensor) {
                Some(listed) => *listed = rank.min(*listed),
                None => drop(self.names.insert(place.sensor.clone(), rank)),
            }
        }
    }

    /// The sensor that a message of channel `id` is of, whose header says `number`.
    pub(crate) fn sensor(&self, id: Option<u16>, number: u8) -> Option<&str> {
        let place = id.and_then(|id| self.channels.place(id)?).filter(|place| place.topic == Topic::Telegram);
        let named = || self.channels.place(self.numbers.get(&number)?.1).flatten();
        place.or_else(named).map(|place| &place.sensor[..])
    }

    /// The header before `lone`, a telegram of `sensor`, unless it contradicts its message, the sensor or the clocks.
    pub(crate) fn header(&self, lone: &Lone, sensor: &str) -> Option<Header> {
        let (header, _) = file::parts(&lone.header)?;
        let fits_message = lone.message.is_none_or(|message| fits(&header, &message));
        let number = self.first(sensor).map(|first| first.sensor);
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
        let (_, id) = self.names.get(sensor)?;
        self.first.get(id).copied()
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

/// Lives of the hub of which a file may tell: one in a minute for a month.
pub(super) const MOST_LIVES: usize = 50_000;
/// Telegrams take no longer.
const LONGEST_NS: u64 = 10_000_000_000;
/// The wall clock is not set by more in a life of the hub, or was not right before.
const STEPPED_NS: u128 = 3_600_000_000_000;
/// Number of a telegram and number of its sample, which are the same unless a sample could not be sent.
const MOST_APART: u64 = 1 << 20;
