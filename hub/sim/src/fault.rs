//! Faults that a simulation injects. A user writes them as `loss=0.00135,burst=1.89`. One table defines the keys with
//! their meaning and range for the parser, the printer and the help.
//!
//! The scanner itself applies its deviations from the protocol ([`ProtocolQuirks`]). [`crate::line_model`] applies all
//! other faults between the scanner and the port:
//!
//! - Damage to bytes. A byte is lost, flipped or doubled, or random bytes arrive before it. Random numbers are drawn
//!   for every byte, even if they have no effect. The same seed therefore damages the same bytes in every run, for any
//!   size of chunks.
//! - Damage to telegrams. A telegram is truncated, aborted or sent twice, or its length field is changed. The random
//!   numbers of a telegram are drawn at its start.
//! - Faults at certain times of the scanner's clock. `Schedule` has points in time, and `FaultWindow` has spans of
//!   time. `Garbage` arrives between or inside telegrams. `Delay` delays chunks.

use std::fmt;
use std::str::FromStr;

use scanhub_drivers::lms;
use scanhub_schema::{Failure, Kind, MILLIS, Nanos};

use crate::machine::ProtocolQuirks;

/// First cause for which a telegram did not reach the host intact. The truth file names it. A telegram is intact if all
/// its bytes arrive as sent and without other bytes between them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// The scanner aborted the telegram, because of a request or spontaneously.
    Aborted,
    /// Bytes were lost on the line.
    Loss,
    /// Bits were flipped.
    Flip,
    /// Random bytes arrived between the bytes of the telegram.
    Insert,
    /// A byte arrived twice.
    Double,
    /// The end of the telegram was lost.
    Truncated,
    /// The length field was changed.
    Length,
    /// A flood of garbage arrived between the bytes of the telegram.
    Flood,
    /// A long run of start bytes arrived between the bytes of the telegram.
    Wall,
    /// The line was interrupted.
    Silence,
    /// The host's adapter was unplugged.
    Unplug,
    /// The power of the scanner was cycled.
    Power,
    /// The rate of the host's port differed from the rate of the line.
    Baud,
    /// No host had the port open.
    Unread,
    /// The host did not read, and its buffer was full.
    Overrun,
}

impl Fault {
    /// Returns the name of the fault in the truth file.
    pub fn name(self) -> &'static str {
        match self {
            Fault::Aborted => "aborted",
            Fault::Loss => "loss",
            Fault::Flip => "flip",
            Fault::Insert => "insert",
            Fault::Double => "double",
            Fault::Truncated => "truncated",
            Fault::Length => "length",
            Fault::Flood => "flood",
            Fault::Wall => "wall",
            Fault::Silence => "silence",
            Fault::Unplug => "unplug",
            Fault::Power => "power",
            Fault::Baud => "baud",
            Fault::Unread => "unread",
            Fault::Overrun => "overrun",
        }
    }
}

/// A row of [`TABLE`]: a key with its meaning, its range, its default, and the field of [`Faults`] that it sets.
struct FaultKey {
    name: &'static str,
    meaning: &'static str,
    min: f64,
    max: f64,
    default: f64,
    field: fn(&mut Faults) -> &mut f64,
}

/// Creates a field of `Faults` and a row of `TABLE` from each line.
macro_rules! faults {
    ($($name:ident, $min:literal to $max:literal, $default:literal, $meaning:literal;)*) => {
        /// Amount of each kind of fault.
        #[derive(Clone, Copy, Debug, PartialEq)]
        pub struct Faults {
            $(#[doc = $meaning] pub $name: f64,)*
        }

        impl Default for Faults {
            /// Returns the values of a line without faults.
            fn default() -> Self {
                Faults { $($name: $default,)* }
            }
        }

        const TABLE: &[FaultKey] = &[$(FaultKey {
            name: stringify!($name),
            meaning: $meaning,
            min: $min,
            max: $max,
            default: $default,
            field: |faults| &mut faults.$name,
        },)*];
    };
}

faults! {
    loss, 0.0 to 0.5, 0.0, "share of the bytes from scanner to host that are lost";
    burst, 1.0 to 1000.0, 1.0, "mean number of consecutive lost bytes, geometric";
    flip, 0.0 to 0.5, 0.0, "share of the bytes in which a run of flipped bits starts";
    flip_bits, 1.0 to 64.0, 1.0, "mean number of neighboring bits in a run, geometric";
    insert, 0.0 to 0.5, 0.0, "share of the bytes with random bytes inserted before them";
    insert_burst, 1.0 to 1000.0, 1.0, "mean number of consecutive random bytes, geometric";
    double, 0.0 to 0.5, 0.0, "share of the bytes that arrive twice";
    repeat, 0.0 to 1.0, 0.0, "share of the telegrams that arrive twice; the copy has its own line in the truth file";
    truncate, 0.0 to 1.0, 0.0, "share of the telegrams whose end is lost";
    length, 0.0 to 1.0, 0.0, "share of the telegrams whose length field is changed";
    abort, 0.0 to 1.0, 0.0, "share of the scans that the scanner aborts spontaneously";
    flood, 0.0 to 8000.0, 0.0, "number of bytes in a flood of garbage";
    flood_every, 0.01 to 86400.0, 1.0, "mean seconds between floods";
    wall, 0.0 to 8000.0, 0.0, "number of bytes in a run of start bytes: 02, 02 80, or headers like the stream's";
    wall_every, 0.01 to 86400.0, 1.0, "mean seconds between runs of start bytes";
    inside, 0.0 to 1.0, 0.5, "share of the floods and of the runs of start bytes that start inside a telegram";
    silence, 0.0 to 86400.0, 0.0, "seconds for which nothing arrives";
    silence_at, 0.0 to 86400.0, 0.0, "time of the first silence, in seconds; 0: 5, or within silence_every";
    silence_every, 0.0 to 86400.0, 0.0, "mean seconds to the next one; 0: only once";
    stall, 0.0 to 86400.0, 0.0, "seconds for which the line holds back all bytes";
    stall_at, 0.0 to 86400.0, 0.0, "as silence_at";
    stall_every, 0.0 to 86400.0, 0.0, "as silence_every";
    delay, 0.0 to 10.0, 0.0, "maximum random delay of each chunk, in seconds";
    unplug, 0.0 to 86400.0, 0.0, "seconds for which the adapter is unplugged";
    unplug_at, 0.0 to 86400.0, 0.0, "as silence_at";
    unplug_every, 0.0 to 86400.0, 0.0, "as silence_every";
    power_at, 0.0 to 86400.0, 0.0, "time of the first power cycle, in seconds; 0: within power_every";
    power_every, 0.0 to 86400.0, 0.0, "mean seconds to the next one; 0: only once";
    brownout_at, 0.0 to 86400.0, 0.0, "time of the first brown-out, which restarts the scanner, as power_at";
    brownout_every, 0.0 to 86400.0, 0.0, "as power_every";
    hold, 0.0 to 86400.0, 0.0, "RPLIDAR: seconds for which the head is blocked";
    hold_at, 0.0 to 86400.0, 0.0, "as silence_at";
    hold_every, 0.0 to 86400.0, 0.0, "as silence_every";
    health, 0.0 to 2.0, 0.0, "RPLIDAR: health status until a RESET: 1 warning, 2 error";
    stubborn, 0.0 to 1.0, 0.0, "1: the health status remains after a RESET";
    id, 0.0 to 255.0, 0.0, "RPLIDAR: number that the scanner reports as its model, such as 0x95; 0: that of the model";
    overlook, 0.0 to 1.0, 0.0, "share of the requests that the scanner ignores";
    nak, 0.0 to 1.0, 0.0, "share of the requests that the scanner answers with NAK";
    twice, 0.0 to 1.0, 0.0, "share of the replies that the scanner sends twice";
    late, 0.0 to 60.0, 0.0, "additional delay of replies, in seconds";
    late_ack, 0.0 to 60.0, 0.0, "additional delay of an ACK, in seconds";
    late_mode, 0.0 to 60.0, 0.0, "additional seconds for a change of mode, rate or variant";
    late_write, 0.0 to 60.0, 0.0, "additional seconds for a write to the EEPROM";
    strict, 0.0 to 1.0, 0.0, "1: the scanner does not measure in installation mode";
    strict_gap, 0.0 to 1.0, 0.0, "1: the scanner drops requests whose bytes arrive less than 55 us apart";
    answer, 0.0 to 10.0, 0.0, "seconds from each ACK to the reply; 0: random, 0.055 to 0.145";
    refuse, 0.0 to 255.0, 0.0, "command that the scanner refuses, such as 0x3B";
    mute, 0.0 to 1.0, 0.0, "1: the scanner sends no replies";
    rs232, 0.0 to 1.0, 0.0, "1: the line is RS-232, which carries nothing at 500000 baud or more";
}

impl Faults {
    /// Returns each key with a text that contains its meaning, range and default.
    pub fn keys() -> impl Iterator<Item = (&'static str, String)> {
        TABLE.iter().map(|key| {
            let FaultKey { name, meaning, min, max, default, .. } = key;
            (*name, format!("{meaning}, {min} to {max} [{default}]"))
        })
    }

    /// Returns the faults that are deviations of the scanner from the protocol.
    pub fn quirks(&self) -> ProtocolQuirks {
        ProtocolQuirks {
            overlooked_share: self.overlook,
            nak_share: self.nak,
            doubled_share: self.twice,
            late_acknowledge_ns: (self.late_ack * 1e9) as Nanos,
            late_reply_ns: (self.late * 1e9) as Nanos,
            late_mode_ns: (self.late_mode * 1e9) as Nanos,
            late_write_ns: (self.late_write * 1e9) as Nanos,
            is_strict: self.strict > 0.0,
            checks_gaps: self.strict_gap > 0.0,
            reply_delay_ns: (self.answer * 1e9) as Nanos,
            refused_commands: if self.refuse > 0.0 { vec![self.refuse as u8] } else { Vec::new() },
            is_mute: self.mute > 0.0,
        }
    }
}

impl FromStr for Faults {
    type Err = Failure;

    fn from_str(text: &str) -> Result<Self, Failure> {
        let mut faults = Faults::default();
        for part in text.split(',').filter(|part| !part.is_empty()) {
            let (name, value) =
                part.split_once('=').ok_or_else(|| invalid_fault(part, "is not KEY=VALUE", key_names()))?;
            let key = TABLE.iter().find(|key| key.name == name);
            let FaultKey { min, max, field, .. } =
                key.ok_or_else(|| invalid_fault(part, "is not a known fault", key_names()))?;
            let number = match value.strip_prefix("0x") {
                Some(digits) => u8::from_str_radix(digits, 16).ok().map(f64::from),
                None => value.parse().ok(),
            };
            *field(&mut faults) =
                number.filter(|number| (*min..=*max).contains(number)).ok_or_else(|| {
                    invalid_fault(
                        part,
                        "is out of range",
                        format!("set {name} to a number from {min} to {max}"),
                    )
                })?;
        }
        Ok(faults)
    }
}

impl fmt::Display for Faults {
    /// Writes the keys whose values differ from the defaults, in the form that the parser accepts. If there are no
    /// faults, the text is empty.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut faults = *self;
        let parts = TABLE.iter().filter_map(|key| {
            let value = *(key.field)(&mut faults);
            (value != key.default).then(|| format!("{}={value}", key.name))
        });
        f.write_str(&parts.collect::<Vec<_>>().join(","))
    }
}

fn invalid_fault(part: &str, what: &str, hint: String) -> Failure {
    Failure::new(Kind::Configuration, format!("fault {part:?} {what}"), hint)
}

fn key_names() -> String {
    format!("keys: {}", TABLE.iter().map(|key| key.name).collect::<Vec<_>>().join(", "))
}

/// Returns the generator of random numbers for one `kind` of fault. Each kind has a separate sequence, so that changing
/// one kind of fault does not change the others.
fn random(seed: u64, kind: u64) -> fastrand::Rng {
    fastrand::Rng::with_seed(seed ^ kind.wrapping_mul(0x9E37_79B9_7F4A_7C15))
}

/// Loses bytes in bursts. With the same seed, it loses the same bytes in every run.
#[derive(Clone, Debug)]
pub struct Loss {
    /// Probability that a burst begins after a byte that arrived.
    begin_share: f64,
    /// Probability that a burst continues.
    continue_share: f64,
    is_in_burst: bool,
    random: fastrand::Rng,
}

impl Loss {
    /// Creates the losses of `faults` with `seed`.
    pub fn new(faults: Faults, seed: u64) -> Self {
        Loss {
            // Bursts have the mean length b, and the runs between them have the mean length 1/begin. The share of lost
            // bytes is therefore b / (b + 1/begin), which must be `loss`.
            begin_share: faults.loss / (faults.burst * (1.0 - faults.loss)),
            continue_share: 1.0 - 1.0 / faults.burst,
            is_in_burst: false,
            random: fastrand::Rng::with_seed(seed),
        }
    }

    /// Removes the lost bytes from `bytes`. Returns whether any byte was lost.
    pub fn apply(&mut self, bytes: &mut Vec<u8>) -> bool {
        let before = bytes.len();
        bytes.retain(|_| !self.next());
        bytes.len() < before
    }

    /// Returns whether the next byte is lost.
    fn next(&mut self) -> bool {
        if self.begin_share == 0.0 {
            return false;
        }
        let chance = if self.is_in_burst { self.continue_share } else { self.begin_share };
        self.is_in_burst = self.random.f64() < chance;
        self.is_in_burst
    }
}

/// Damage to one byte.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct ByteOutcome {
    /// Bytes that are inserted before this byte.
    pub(crate) inserted: Vec<u8>,
    pub(crate) is_lost: bool,
    /// Mask of the flipped bits.
    pub(crate) flip_mask: u8,
    pub(crate) is_doubled: bool,
}

/// The faults of single bytes.
#[derive(Clone, Debug)]
pub(crate) struct Noise {
    loss: Loss,
    flip: f64,
    flip_bits: f64,
    /// Number of bits of the current run that belong to the next byte.
    bits_left: u32,
    flips: fastrand::Rng,
    insert: f64,
    insert_burst: f64,
    inserts: fastrand::Rng,
    double: f64,
    doubles: fastrand::Rng,
}

impl Noise {
    pub(crate) fn new(faults: &Faults, seed: u64) -> Noise {
        Noise {
            loss: Loss::new(*faults, seed),
            flip: faults.flip,
            flip_bits: faults.flip_bits,
            bits_left: 0,
            flips: random(seed, 1),
            insert: faults.insert,
            insert_burst: faults.insert_burst,
            inserts: random(seed, 2),
            double: faults.double,
            doubles: random(seed, 3),
        }
    }

    /// Returns the damage to the next byte.
    pub(crate) fn next(&mut self) -> ByteOutcome {
        ByteOutcome {
            inserted: self.inserted_bytes(),
            is_lost: self.loss.next(),
            flip_mask: self.flip_mask(),
            is_doubled: draw(&mut self.doubles, self.double),
        }
    }

    /// Returns the mask of flipped bits. The lowest bit is sent first, so a run continues in the low bits of the next
    /// byte.
    fn flip_mask(&mut self) -> u8 {
        let mut first = 0;
        if self.bits_left == 0 {
            if !draw(&mut self.flips, self.flip) {
                return 0;
            }
            first = self.flips.u32(..8);
            self.bits_left = geometric(&mut self.flips, self.flip_bits);
        }
        let run_bits = self.bits_left.min(8 - first);
        self.bits_left -= run_bits;
        (((1u16 << run_bits) - 1) << first) as u8
    }

    fn inserted_bytes(&mut self) -> Vec<u8> {
        if !draw(&mut self.inserts, self.insert) {
            return Vec::new();
        }
        let count = geometric(&mut self.inserts, self.insert_burst);
        (0..count).map(|_| self.inserts.u8(..)).collect()
    }
}

/// Returns whether an event with the probability `share` happens. Draws no number if `share` is 0.
fn draw(random: &mut fastrand::Rng, share: f64) -> bool {
    share > 0.0 && random.f64() < share
}

/// Returns a number from a geometric distribution: 1 or more, `mean` on average.
fn geometric(random: &mut fastrand::Rng, mean: f64) -> u32 {
    let mut count = 1;
    while draw(random, 1.0 - 1.0 / mean) {
        count += 1;
    }
    count
}

/// Faults of telegrams, and their values for the telegram on the line.
#[derive(Clone, Debug)]
pub(crate) struct TelegramFaults {
    truncate: f64,
    length: f64,
    repeat: f64,
    abort: f64,
    random: fastrand::Rng,
    /// Share of the bytes that arrive if the telegram is truncated; `None` if it is not truncated.
    arriving_share: Option<f64>,
    /// Mask of the flipped bits of the length field; 0 if no bit is flipped.
    length_mask: u16,
    is_repeated: bool,
    /// Share of the bytes after which the scanner aborts the telegram; `None` if it sends the whole telegram.
    abort_share: Option<f64>,
    /// Length of the telegram. It is complete only after both bytes of the length field were sent.
    len: usize,
    has_length_field: bool,
}

impl TelegramFaults {
    pub(crate) fn new(faults: &Faults, seed: u64) -> TelegramFaults {
        TelegramFaults {
            truncate: faults.truncate,
            length: faults.length,
            repeat: faults.repeat,
            abort: faults.abort,
            random: random(seed, 4),
            arriving_share: None,
            length_mask: 0,
            is_repeated: false,
            abort_share: None,
            len: 0,
            has_length_field: true,
        }
    }

    /// Starts a telegram of `len` bytes. `None` means that the telegram has a length field.
    pub(crate) fn begin(&mut self, len: Option<usize>) {
        let shares = [self.random.f64(), self.random.f64()];
        // The first mask changes only the low ten bits, so the changed length may still be valid. It is used for half
        // of the changed lengths.
        let masks = [self.random.u16(1..0x0400), self.random.u16(1..)];
        let mask = masks[usize::from(self.random.bool())];
        self.arriving_share = draw(&mut self.random, self.truncate).then_some(shares[0]);
        self.length_mask = if draw(&mut self.random, self.length) { mask } else { 0 };
        self.is_repeated = draw(&mut self.random, self.repeat);
        self.abort_share = draw(&mut self.random, self.abort).then_some(shares[1]);
        self.len = len.unwrap_or(lms::telegram::FRAME_LEN);
        self.has_length_field = len.is_none();
    }

    /// Returns the byte that arrives if the scanner sends `byte` at `position` of the telegram, and the fault that
    /// occurred. The byte is `None` if it is lost.
    pub(crate) fn apply(&mut self, position: usize, byte: u8) -> (Option<u8>, Option<Fault>) {
        let [low, high] = self.length_mask.to_le_bytes();
        // A telegram of a fixed length has a single length byte, after its first byte.
        let flipped = match (self.has_length_field, position) {
            (true, 2) | (false, 1) => low,
            (true, 3) => high,
            _ => 0,
        };
        match position {
            2 if self.has_length_field => self.len += usize::from(byte),
            3 if self.has_length_field => self.len += usize::from(byte) << 8,
            _ => {}
        }
        if position > 3 && self.arriving_share.is_some_and(|share| position >= self.position_at(share)) {
            return (None, Some(Fault::Truncated));
        }
        (Some(byte ^ flipped), (flipped != 0).then_some(Fault::Length))
    }

    /// Returns whether the scanner aborts the telegram after `position` bytes.
    pub(crate) fn aborts_at(&self, position: usize) -> bool {
        position > 4 && self.abort_share.is_some_and(|share| position >= self.position_at(share))
    }

    /// Returns whether the telegram is sent twice.
    pub(crate) fn is_repeated(&self) -> bool {
        self.is_repeated
    }

    /// Returns the position at `share` of the telegram's length. It is after the first byte and within the telegram.
    fn position_at(&self, share: f64) -> usize {
        1 + (share * (self.len - 1) as f64) as usize
    }
}

/// Points in time at which a fault happens.
#[derive(Clone, Debug)]
pub(crate) struct Schedule {
    every_s: f64,
    next_ns: Nanos,
    random: fastrand::Rng,
}

impl Schedule {
    /// Creates a schedule. The first time is `at_s` seconds. Each later time follows `every_s` seconds, on average,
    /// after the previous time. If `every_s` is 0, there is only the first time. If `at_s` is 0, the first time is
    /// drawn like the later times. If both are 0, the only time is [`DEFAULT_FAULT_TIME_S`].
    pub(crate) fn new(at_s: f64, every_s: f64, random: fastrand::Rng) -> Schedule {
        let mut schedule = Schedule { every_s, next_ns: 0, random };
        schedule.next_ns = match (at_s > 0.0, every_s > 0.0) {
            (true, _) => nanos(at_s),
            (false, true) => schedule.interval_ns(),
            (false, false) => nanos(DEFAULT_FAULT_TIME_S),
        };
        schedule
    }

    /// Returns the times of the scanner's power cycles.
    pub(crate) fn power_cycles(faults: &Faults, seed: u64) -> Schedule {
        Schedule::if_configured(faults.power_at, faults.power_every, random(seed, 7))
    }

    /// Returns the times at which the scanner's voltage dips.
    pub(crate) fn brownouts(faults: &Faults, seed: u64) -> Schedule {
        Schedule::if_configured(faults.brownout_at, faults.brownout_every, random(seed, 12))
    }

    /// Creates a schedule as [`Schedule::new`] does, or an empty one if both times are 0.
    fn if_configured(at_s: f64, every_s: f64, random: fastrand::Rng) -> Schedule {
        if at_s + every_s > 0.0 { Schedule::new(at_s, every_s, random) } else { Schedule::never() }
    }

    /// Returns an empty schedule.
    pub(crate) fn never() -> Schedule {
        Schedule { every_s: 0.0, next_ns: Nanos::MAX, random: fastrand::Rng::with_seed(0) }
    }

    pub(crate) fn next_ns(&self) -> Nanos {
        self.next_ns
    }

    /// Removes and returns the next time, unless it is after `now`.
    pub(crate) fn take(&mut self, now: Nanos) -> Option<Nanos> {
        let at_ns = Some(self.next_ns).filter(|&at| at <= now)?;
        let interval_ns = if self.every_s > 0.0 { self.interval_ns() } else { Nanos::MAX };
        self.next_ns = at_ns.saturating_add(interval_ns);
        Some(at_ns)
    }

    fn interval_ns(&mut self) -> Nanos {
        nanos(self.every_s * (0.5 + self.random.f64())).max(MILLIS)
    }
}

/// Spans of time in which a fault is present.
#[derive(Clone, Debug)]
pub(crate) struct FaultWindow {
    begins: Schedule,
    span_ns: Nanos,
    /// End of the latest span that has started.
    until_ns: Nanos,
}

impl FaultWindow {
    /// Creates spans of `span_s` seconds that start at the times of [`Schedule::new`]. If `span_s` is 0, there are no
    /// spans.
    pub(crate) fn new(span_s: f64, at_s: f64, every_s: f64, random: fastrand::Rng) -> FaultWindow {
        let begins = if span_s > 0.0 { Schedule::new(at_s, every_s, random) } else { Schedule::never() };
        FaultWindow { begins, span_ns: nanos(span_s), until_ns: 0 }
    }

    /// Creates a single span, which starts at `begin_ns`.
    pub(crate) fn once(begin_ns: Nanos, span_ns: Nanos) -> FaultWindow {
        let begins = Schedule { next_ns: begin_ns, ..Schedule::never() };
        FaultWindow { begins, span_ns, until_ns: 0 }
    }

    /// Returns the spans of time in which no byte arrives.
    pub(crate) fn silences(faults: &Faults, seed: u64) -> FaultWindow {
        FaultWindow::new(faults.silence, faults.silence_at, faults.silence_every, random(seed, 8))
    }

    /// Returns the spans of time in which the port is unplugged.
    pub(crate) fn unplugs(faults: &Faults, seed: u64) -> FaultWindow {
        FaultWindow::new(faults.unplug, faults.unplug_at, faults.unplug_every, random(seed, 9))
    }

    /// Returns the spans of time in which the head of the scanner is blocked.
    pub(crate) fn stalls(faults: &Faults, seed: u64) -> FaultWindow {
        FaultWindow::new(faults.hold, faults.hold_at, faults.hold_every, random(seed, 13))
    }

    /// Returns whether the fault is present at `now`. Time must not go backwards.
    pub(crate) fn is_active(&mut self, now: Nanos) -> bool {
        while let Some(begin_ns) = self.begins.take(now) {
            self.until_ns = begin_ns + self.span_ns;
        }
        now < self.until_ns
    }

    /// Returns the end of the span that contains `now`, or `now` if no span contains it.
    pub(crate) fn end_ns(&mut self, now: Nanos) -> Nanos {
        if self.is_active(now) { self.until_ns } else { now }
    }

    /// Returns the next time after `now` at which a span starts or ends.
    pub(crate) fn next_ns(&self, now: Nanos) -> Nanos {
        if now < self.until_ns { self.until_ns.min(self.begins.next_ns()) } else { self.begins.next_ns() }
    }
}

/// Garbage that arrives at random times, between telegrams or inside one.
#[derive(Clone, Debug)]
pub(crate) struct Garbage {
    pub(crate) fault: Fault,
    schedule: Schedule,
    len: usize,
    inside_share: f64,
    random: fastrand::Rng,
    /// Whether the next garbage arrives inside a telegram.
    is_next_inside: bool,
    /// Number of bytes of a telegram that still pass before garbage that is due inside the telegram.
    bytes_to_pass: usize,
}

impl Garbage {
    /// Creates floods of random bytes.
    pub(crate) fn floods(faults: &Faults, seed: u64) -> Garbage {
        Garbage::new(Fault::Flood, faults.flood, faults.flood_every, faults.inside, random(seed, 5))
    }

    /// Creates long runs of start bytes.
    pub(crate) fn walls(faults: &Faults, seed: u64) -> Garbage {
        Garbage::new(Fault::Wall, faults.wall, faults.wall_every, faults.inside, random(seed, 6))
    }

    fn new(fault: Fault, len: f64, every_s: f64, inside: f64, mut random: fastrand::Rng) -> Garbage {
        let happens = len >= 1.0;
        let schedule = if happens { Schedule::new(0.0, every_s, random.fork()) } else { Schedule::never() };
        let wants_inside = random.f64() < inside;
        Garbage {
            fault,
            schedule,
            len: len as usize,
            inside_share: inside,
            random,
            is_next_inside: wants_inside,
            bytes_to_pass: 0,
        }
    }

    /// Returns the time of the next garbage if it arrives at the place that `inside` selects: inside a telegram if it
    /// is set, and otherwise between two telegrams. Returns [`Nanos::MAX`] if the next garbage arrives at the other
    /// place.
    pub(crate) fn due_ns(&self, inside: bool) -> Nanos {
        if inside == self.is_next_inside { self.schedule.next_ns() } else { Nanos::MAX }
    }

    /// Returns the garbage that is due before the byte that ends at `now`. `inside` is as in [`Garbage::due_ns`].
    /// `header` contains the first bytes of the stream's telegrams, which runs of start bytes imitate.
    pub(crate) fn take(&mut self, now: Nanos, inside: bool, header: &[u8]) -> Option<Vec<u8>> {
        if self.due_ns(inside) > now {
            return None;
        }
        if inside && self.bytes_to_pass > 0 {
            self.bytes_to_pass -= 1;
            return None;
        }
        self.schedule.take(now)?;
        self.is_next_inside = self.random.f64() < self.inside_share;
        self.bytes_to_pass = self.random.usize(..64);
        if self.fault == Fault::Flood {
            return Some((0..self.len).map(|_| self.random.u8(..)).collect());
        }
        // Before the start of the stream, no header is known, so use the first bytes of an LMS telegram.
        let header = if header.len() < 2 { &[0x02, 0x80] } else { header };
        let bricks: [&[u8]; 3] = [&header[..1], &header[..2], header];
        let brick = bricks[self.random.usize(..3)];
        Some(brick.iter().copied().cycle().take(self.len).collect())
    }
}

fn nanos(seconds: f64) -> Nanos {
    (seconds * 1e9) as Nanos
}

/// Delays of chunks: spans of time in which no chunk arrives, and random delays. The order of the chunks never changes.
#[derive(Clone, Debug)]
pub(crate) struct Delay {
    stall: FaultWindow,
    /// Maximum random delay of a chunk.
    delay_ns: Nanos,
    random: fastrand::Rng,
    /// Time at which the latest chunk arrives. No later chunk arrives before it.
    last_ns: Nanos,
}

impl Delay {
    pub(crate) fn new(faults: &Faults, seed: u64) -> Delay {
        Delay {
            stall: FaultWindow::new(faults.stall, faults.stall_at, faults.stall_every, random(seed, 10)),
            delay_ns: (faults.delay * 1e9) as Nanos,
            random: random(seed, 11),
            last_ns: 0,
        }
    }

    /// Returns these delays, changed so that no later chunk arrives before the chunks that `other` has delayed.
    pub(crate) fn after(self, other: &Delay) -> Delay {
        Delay { last_ns: other.last_ns, ..self }
    }

    /// Returns the time at which a chunk arrives if its transmission ends at `now`.
    pub(crate) fn release_ns(&mut self, now: Nanos) -> Nanos {
        let delay_ns = if self.delay_ns > 0 { self.random.u64(..=self.delay_ns) } else { 0 };
        self.last_ns = self.last_ns.max(self.stall.end_ns(now) + delay_ns);
        self.last_ns
    }
}

/// Time of a single fault for which no time is configured, in seconds. By then, the hub's session has started the
/// stream.
const DEFAULT_FAULT_TIME_S: f64 = 5.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_and_prints_faults() {
        let faults: Faults = "loss=0.00135,burst=1.89".parse().unwrap();
        assert_eq!(faults, Faults { loss: 0.00135, burst: 1.89, ..Faults::default() });
        assert_eq!(faults.to_string(), "loss=0.00135,burst=1.89");
        assert_eq!(("".parse(), Faults::default().to_string()), (Ok(Faults::default()), String::new()));
        for (text, message) in [
            ("los=0.1", "loss, burst"),
            ("loss", "loss, burst"),
            ("loss=2", "from 0 to 0.5"),
            ("loss=x", "from 0 to 0.5"),
            ("burst=0.5", "from 1 to 1000"),
            ("burst=nan", "from 1 to 1000"),
            ("refuse=0x100", "from 0 to 255"),
        ] {
            let failure = text.parse::<Faults>().unwrap_err();
            assert!(failure.hint.contains(message), "{text}: {failure}");
            assert!(failure.message.contains(text), "{text}: {failure}");
            assert_eq!(failure.kind.exit_code(), 78);
        }
    }

    #[test]
    fn every_fault_key_round_trips_and_is_off_by_default() {
        for key in TABLE {
            let mut faults = Faults::default();
            assert_eq!(*(key.field)(&mut faults), key.default);
            *(key.field)(&mut faults) = key.max;
            let text = faults.to_string();
            assert_eq!((text.parse(), text), (Ok(faults), format!("{}={}", key.name, key.max)));
        }
        let quirks = "overlook=0.5,late=1.5,refuse=0x3B,mute=1".parse::<Faults>().unwrap().quirks();
        assert_eq!((quirks.overlooked_share, quirks.late_reply_ns), (0.5, 1_500_000_000));
        assert_eq!((quirks.refused_commands, quirks.is_mute), (vec![0x3B], true));
        let quirks = "strict_gap=1,answer=0.06".parse::<Faults>().unwrap().quirks();
        assert_eq!((quirks.checks_gaps, quirks.reply_delay_ns), (true, 60_000_000));
        let quirks = "late_mode=2.5,late_write=6".parse::<Faults>().unwrap().quirks();
        assert_eq!((quirks.late_mode_ns, quirks.late_write_ns), (2_500_000_000, 6_000_000_000));
        assert_eq!(Faults::default().quirks(), ProtocolQuirks::default());
    }

    #[test]
    fn damages_share_of_telegrams_as_measured() {
        // If 0.135 % of the bytes are lost, in bursts of 1.89 bytes on average, 40.8 % of the telegrams of 732 bytes
        // are damaged.
        let mut loss = Loss::new(Faults { loss: 0.00135, burst: 1.89, ..Faults::default() }, 1);
        let (telegrams, mut damaged, mut lost) = (20_000, 0, 0);
        for _ in 0..telegrams {
            let mut bytes = vec![0; 732];
            damaged += u32::from(loss.apply(&mut bytes));
            lost += 732 - bytes.len();
        }
        let share = lost as f64 / (732.0 * f64::from(telegrams));
        assert!((share - 0.00135).abs() < 0.00005, "{share}");
        let damaged = f64::from(damaged) / f64::from(telegrams);
        assert!((damaged - 0.408).abs() < 0.01, "{damaged}");
    }

    #[test]
    fn loses_same_bytes_for_any_chunk_size() {
        let faults = Faults { loss: 0.05, burst: 3.0, ..Faults::default() };
        let bytes: Vec<u8> = (0..5000).map(|i| i as u8).collect();
        let mut whole = bytes.clone();
        assert!(Loss::new(faults, 9).apply(&mut whole));
        let mut loss = Loss::new(faults, 9);
        let mut cut = Vec::new();
        for chunk in bytes.chunks(62) {
            let mut chunk = chunk.to_vec();
            loss.apply(&mut chunk);
            cut.append(&mut chunk);
        }
        assert_eq!(cut, whole);
        assert!(!Loss::new(Faults::default(), 9).apply(&mut whole));
    }

    #[test]
    fn faults_have_configured_shares_and_are_independent() {
        let faults =
            Faults { flip: 0.01, flip_bits: 3.0, insert: 0.02, insert_burst: 4.0, ..Faults::default() };
        let faults = Faults { double: 0.03, ..faults };
        let mut noise = Noise::new(&faults, 1);
        let outcomes: Vec<ByteOutcome> = (0..100_000).map(|_| noise.next()).collect();
        let bits: u32 = outcomes.iter().map(|outcome| outcome.flip_mask.count_ones()).sum();
        let inserted: usize = outcomes.iter().map(|outcome| outcome.inserted.len()).sum();
        let doubled = outcomes.iter().filter(|outcome| outcome.is_doubled).count();
        assert!((2_700..3_300).contains(&bits), "{bits}");
        assert!((7_300..8_700).contains(&inserted), "{inserted}");
        assert!((2_800..3_200).contains(&doubled), "{doubled}");
        let mut alone = Noise::new(&Faults { double: 0.03, ..Faults::default() }, 1);
        assert!(outcomes.iter().all(|outcome| alone.next().is_doubled == outcome.is_doubled));
        let mut nothing = Noise::new(&Faults::default(), 1);
        assert_eq!(nothing.next(), ByteOutcome::default());
    }

    #[test]
    fn truncates_telegrams_and_changes_lengths() {
        let telegram = lms::reply::mode_reply(0, true, 0x10).bytes().to_vec();
        let mut cuts = std::collections::HashSet::new();
        let mut telegram_faults = TelegramFaults::new(&Faults { truncate: 1.0, ..Faults::default() }, 3);
        for _ in 0..200 {
            telegram_faults.begin(None);
            let arrived: Vec<u8> = telegram
                .iter()
                .enumerate()
                .filter_map(|(at, &byte)| telegram_faults.apply(at, byte).0)
                .collect();
            assert!(arrived.len() < telegram.len() && telegram.starts_with(&arrived));
            cuts.insert(arrived.len());
        }
        assert_eq!(cuts.len(), 5, "{cuts:?}");
        let mut telegram_faults = TelegramFaults::new(&Faults { length: 1.0, ..Faults::default() }, 3);
        for _ in 0..200 {
            telegram_faults.begin(None);
            let arrived: Vec<u8> = telegram
                .iter()
                .enumerate()
                .filter_map(|(at, &byte)| telegram_faults.apply(at, byte).0)
                .collect();
            assert!(arrived[2..4] != telegram[2..4] && arrived[4..] == telegram[4..]);
        }
    }

    const S: Nanos = 1_000_000_000;

    #[test]
    fn spans_begin_and_end_at_their_times() {
        let mut window = FaultWindow::new(1.5, 3.0, 0.0, random(1, 1));
        assert_eq!((window.next_ns(0), window.is_active(3 * S - 1)), (3 * S, false));
        assert!(window.is_active(3 * S) && window.is_active(4 * S));
        assert_eq!(window.next_ns(4 * S), 4 * S + S / 2);
        assert!(!window.is_active(4 * S + S / 2) && !window.is_active(100 * S));
        assert_eq!(window.next_ns(100 * S), Nanos::MAX);
        assert!(!FaultWindow::new(0.0, 3.0, 1.0, random(1, 1)).is_active(50 * S));
        assert!(FaultWindow::new(1.0, 0.0, 0.0, random(1, 1)).is_active(5 * S));
    }

    #[test]
    fn repeats_at_mean_interval() {
        let mut schedule = Schedule::new(0.0, 2.0, random(1, 1));
        let times = (0..200 * 100).filter(|i| schedule.take(i * S / 100).is_some()).count();
        assert!((85..115).contains(&times), "{times}");
    }
}
