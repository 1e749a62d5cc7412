//! The sensor's side of the conversation, without a line and without a clock: host bytes and times go in, chunks of bytes
//! with the time at which they have been sent come out. [`Source`] provides what it measures, `answer.rs` what it answers;
//! it does not know what is lost on the way.
//!
//! It is driven as a [`Device`].

use std::collections::VecDeque;

use scanhub_drivers::lms::telegram::{ACK, NAK, REPLY, Telegram};
use scanhub_drivers::lms::variant::{Baud, MIRROR_TURN, Variant};
use schema::{MILLIS, Nanos};

use crate::answer::{After, Answer};
use crate::device::{Chunk, Device, Part, Sent};
use crate::eeprom::Eeprom;
use crate::operating::{Operating, Shot};
use crate::request_decoder::{Arrival, Dropped, Heard, RequestDecoder};
use crate::source::Source;
use crate::transmission::Transmission;

pub use crate::settings::{Habits, Settings, Start};

/// The sensor.
pub struct Machine {
    pub(crate) settings: Settings,
    pub(crate) source: Source,
    /// What outlives a power cycle.
    pub(crate) eeprom: Eeprom,
    pub(crate) operating: Operating,
    pub(crate) variant: Variant,
    baud: Baud,
    decoder: RequestDecoder,
    pub(crate) random: fastrand::Rng,
    habits: fastrand::Rng,
    queue: VecDeque<Transmission<Tag>>,
    /// When the next scan of the stream begins to leave; `None` while there is no stream.
    next_scan_ns: Option<Nanos>,
    /// Before it has started it hears nothing.
    started_ns: Nanos,
    /// Telegrams of measured values since power-on.
    scans: u64,
    /// Partial scans since the operating mode was changed.
    pub(crate) partials: u64,
}

/// What a transmission is.
#[derive(Clone, Copy, Debug)]
enum Tag {
    Acknowledge,
    Scan,
    /// A reply, whether the next request leaves it in its place, and what follows from it.
    Reply {
        late: bool,
        after: After,
    },
}

impl Machine {
    /// The sensor that `settings` describe, at time 0.
    pub fn new(settings: Settings, source: Source) -> Self {
        let mut machine = Machine {
            eeprom: Eeprom::new(&settings),
            operating: Operating::OnRequest,
            variant: settings.variant,
            baud: settings.baud,
            decoder: RequestDecoder::new(settings.speed, settings.habits.strict_gap),
            random: fastrand::Rng::with_seed(settings.seed),
            habits: fastrand::Rng::with_seed(!settings.seed),
            settings,
            source,
            queue: VecDeque::new(),
            next_scan_ns: None,
            started_ns: 0,
            scans: 0,
            partials: 0,
        };
        match machine.settings.start.clone() {
            Start::In(operating) => {
                machine.next_scan_ns = operating.streams().then_some(0);
                machine.operating = operating;
            }
            Start::PowerOn => machine.boot(0),
        }
        machine
    }

    /// Rate of the line at which it hears now.
    pub fn baud(&self) -> Baud {
        self.baud
    }

    /// What it does now.
    pub fn operating(&self) -> &Operating {
        &self.operating
    }

    /// From now on it behaves like this.
    pub fn set_habits(&mut self, habits: Habits) {
        self.decoder.is_strict = habits.strict_gap;
        self.settings.habits = habits;
    }

    /// A telegram of measured values of a sensor in `operating`, the scan of which ended at `at_ns`.
    pub(crate) fn measure(&mut self, operating: &Operating, at_ns: Nanos) -> Option<Vec<u8>> {
        let (variant, unit, mode) = (self.variant, self.eeprom.unit(), self.eeprom.mode());
        let Settings { address, status, .. } = self.settings;
        let index = self.eeprom.has_indices().then_some(self.scans as u8);
        let turn = self.partials;
        self.scans += 1;
        self.partials += u64::from(*operating == Operating::Partial);
        let shot = |room| Shot { room, variant, unit, mode, at_ns, address, status, index, turn };
        self.source.telegram(operating, shot)
    }

    /// Puts the next scan of the stream on the line if it is due.
    fn start_scan(&mut self, now: Nanos) {
        let Some(start_ns) = self.next_scan_ns.filter(|&at| at <= now) else { return };
        // At the end of a recording there is none: the line stays open and silent.
        self.next_scan_ns = None;
        let operating = self.operating.clone();
        let Some(telegram) = self.measure(&operating, start_ns) else { return };
        let period_ns = operating.period(self.variant, telegram.len(), self.baud.rate());
        self.next_scan_ns = Some(start_ns + period_ns);
        self.send(telegram, start_ns, Tag::Scan);
    }

    /// Takes the finished transmission off the line and does what follows from it.
    fn finish_front(&mut self, part: Part) -> Part {
        let Some(front) = self.queue.pop_front() else { return part };
        let (end_ns, aborted) = (front.end_ns(), front.is_broken());
        match front.tag {
            Tag::Reply { after: After::Baud(baud), .. } => self.baud = baud,
            Tag::Reply { after: After::Reset, .. } => self.boot(end_ns + RESET_NS),
            _ => {}
        }
        if let Some(next) = self.queue.front_mut() {
            next.start_no_earlier(end_ns);
        } else if self.operating.streams() && (aborted || !matches!(front.tag, Tag::Scan)) {
            // The stream goes on with a whole scan, where the mirror begins one.
            let scan_ns = self.operating.turns(self.variant) * MIRROR_TURN;
            self.next_scan_ns = Some(end_ns.next_multiple_of(scan_ns));
        }
        let (telegram, tag) = front.into_parts();
        match tag {
            Tag::Acknowledge => part,
            Tag::Scan | Tag::Reply { .. } => {
                Part::End(Sent { is_reply: matches!(tag, Tag::Reply { .. }), telegram, aborted })
            }
        }
    }

    /// The host is master: what is being sent ends with the byte in the transmitter, what was to be sent is not.
    /// Returns when the line is free.
    fn interrupt(&mut self, now: Nanos) -> Nanos {
        self.next_scan_ns = None;
        let mut is_first = true;
        self.queue.retain(|transmission| {
            let on_line = std::mem::take(&mut is_first) && transmission.start_ns() <= now;
            on_line || matches!(transmission.tag, Tag::Reply { late: true, .. })
        });
        let Some(front) = self.queue.front_mut().filter(|front| front.start_ns() <= now) else { return now };
        front.break_off(now);
        front.end_ns().max(now)
    }

    /// Begins a start-up at `now`: the banner is what it says first.
    fn boot(&mut self, now: Nanos) {
        self.next_scan_ns = None;
        self.operating = Operating::OnRequest;
        self.variant = self.settings.variant;
        self.baud = self.eeprom.power_on_baud();
        self.scans = 0;
        self.partials = 0;
        self.started_ns = now + self.settings.boot_ns;
        self.decoder = RequestDecoder::new(self.settings.speed, self.settings.habits.strict_gap);
        self.send(self.banner(), self.started_ns, Tag::Reply { late: false, after: After::Nothing });
    }

    /// Queues `bytes` from `start_ns` on, before what starts later; returns when the last one is through.
    fn send(&mut self, bytes: Vec<u8>, start_ns: Nanos, tag: Tag) -> Nanos {
        let transmission = Transmission::new(bytes, start_ns, self.baud.rate(), self.settings.chunk, tag);
        let end_ns = transmission.end_ns();
        let place = self.queue.partition_point(|other| other.start_ns() <= start_ns);
        self.queue.insert(place, transmission);
        end_ns
    }

    fn chance(&mut self, share: f64) -> bool {
        share > 0.0 && self.habits.f64() < share
    }

    /// Address byte of what it sends.
    pub(crate) fn reply_address(&self) -> u8 {
        self.settings.address | REPLY
    }
}

impl Device for Machine {
    fn poll_transmit(&mut self, now: Nanos) -> Option<Chunk> {
        if self.queue.is_empty() {
            self.start_scan(now);
        }
        let front = self.queue.front_mut()?;
        let rate = front.rate();
        let (bytes, idle_after) = front.take_chunk(now)?;
        let bytes = bytes.to_vec();
        let part = match front.tag {
            Tag::Acknowledge => Part::Acknowledge,
            Tag::Scan | Tag::Reply { .. } => Part::Telegram,
        };
        let part = if front.is_done() { self.finish_front(part) } else { part };
        Some(Chunk { bytes, rate, idle_after, part })
    }

    fn poll_timeout(&self) -> Option<Nanos> {
        self.queue.front().map(Transmission::next_chunk_ns).or(self.next_scan_ns)
    }

    fn receive(&mut self, byte: u8, arrival: Arrival) {
        if arrival.not_after < self.started_ns {
            return;
        }
        let Some(Heard { bytes, at }) = self.decoder.hear(byte, arrival, self.baud.rate()) else { return };
        let is_mine = bytes[1] == 0 || bytes[1] == self.settings.address;
        if !is_mine || self.settings.habits.mute || self.chance(self.settings.habits.overlooks) {
            return;
        }
        let free_ns = self.interrupt(at);
        let late_ns = self.settings.habits.late_acknowledge_ns;
        let first_ns = free_ns + late_ns + self.random.u64(2 * MILLIS..8 * MILLIS);
        let request = Telegram::check(&bytes).filter(|_| !self.chance(self.settings.habits.naks));
        let Some(request) = request else {
            self.send(vec![NAK], first_ns, Tag::Acknowledge);
            return;
        };
        let Answer { reply, delay_ns, after } = self.answer(request, first_ns);
        let acknowledged_ns = self.send(vec![ACK], first_ns, Tag::Acknowledge);
        let late_ns = self.settings.habits.late_reply_ns;
        let reply_ns = acknowledged_ns + delay_ns + late_ns;
        let late = late_ns > 0;
        let end_ns = self.send(reply.clone(), reply_ns, Tag::Reply { late, after });
        if self.chance(self.settings.habits.doubles) {
            let again_ns = end_ns + self.habits.u64(..20 * MILLIS);
            self.send(reply, again_ns, Tag::Reply { late, after: After::Nothing });
        }
    }

    /// The power goes off and on: transmission ends with the byte in the transmitter, everything that is not in the EEPROM
    /// is forgotten, and after the start-up time the banner 90h is sent, at the permanent rate or at 9600. Returns whether
    /// a telegram was broken off.
    fn power_cycle(&mut self, now: Nanos) -> bool {
        self.queue.retain(|transmission| transmission.start_ns() <= now);
        self.queue.truncate(1);
        let mut broken = false;
        if let Some(front) = self.queue.front_mut() {
            front.break_off(now);
            broken = front.is_broken();
            if let Tag::Reply { after, .. } = &mut front.tag {
                *after = After::Nothing;
            }
        }
        self.boot(now);
        broken
    }

    /// Breaks off what it is sending, as if for a request that it then ignored; a stream continues with a whole scan.
    fn break_off(&mut self, now: Nanos) {
        if self.queue.front().is_some_and(|front| front.start_ns() <= now) {
            self.interrupt(now);
        }
    }

    /// Requests heard that would write its EEPROM (40 42 46 66 77 7C), done or refused.
    fn eeprom_writes(&self) -> u64 {
        self.eeprom.writes
    }

    fn take_dropped(&mut self) -> Option<Dropped> {
        self.decoder.take_dropped()
    }

    fn rate(&self) -> u32 {
        self.baud.rate()
    }

    fn streams(&self) -> bool {
        self.operating.streams()
    }

    fn telegram_len(&self) -> Option<usize> {
        None
    }
}

/// From 91h to the reset that it announces (Telegram listing, 10h).
const RESET_NS: Nanos = 10 * MILLIS;
