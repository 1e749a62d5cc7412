//! Injected faults. A user writes them as `loss=0.00135,burst=1.89`, and one table has the keys with their meaning and
//! range for the parser, the printer and the help.
//!
//! A seed causes the same damage in every run, for any size of chunks. [`crate::wire`] applies the faults between the
//! scanner and the port, except the scanner's own deviations from the protocol.

mod damage;
mod schedule;

use std::fmt;
use std::str::FromStr;

use schema::{Failure, Kind, Nanos};

use crate::machine::Habits;

pub use damage::Loss;
pub(crate) use damage::{Fate, Noise, TelegramFaults};
pub(crate) use schedule::{Extra, Lateness, Schedule, Window};

/// First cause for which a telegram did not reach the host intact, as recorded in the truth. A telegram is intact if
/// all its bytes arrive as sent and next to each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// The scanner broke off the telegram, for a request or by itself.
    Aborted,
    /// Bytes were lost on the line.
    Loss,
    /// Bits were flipped.
    Flip,
    /// Other bytes arrived between its bytes.
    Insert,
    /// A byte arrived twice.
    Double,
    /// The end of the telegram was lost.
    Truncated,
    /// The length field was changed.
    Length,
    /// A flood of garbage arrived between its bytes.
    Flood,
    /// A wall of start bytes arrived between its bytes.
    Wall,
    /// The line was interrupted.
    Silence,
    /// The host's adapter was unplugged.
    Unplug,
    /// The power of the scanner was cycled.
    Power,
    /// The host's port had another rate.
    Baud,
    /// No host had the port open.
    Unread,
    /// The host did not read, and its buffer was full.
    Overrun,
}

impl Fault {
    /// Returns the name of the fault in the truth.
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

/// A row of the table.
struct Key {
    name: &'static str,
    meaning: &'static str,
    least: f64,
    most: f64,
    default: f64,
    field: fn(&mut Faults) -> &mut f64,
}

/// Creates a field and a key from each row.
macro_rules! faults {
    ($($name:ident, $least:literal to $most:literal, $default:literal, $meaning:literal;)*) => {
        /// Kinds and amounts of faults.
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

        const TABLE: &[Key] = &[$(Key {
            name: stringify!($name),
            meaning: $meaning,
            least: $least,
            most: $most,
            default: $default,
            field: |faults| &mut faults.$name,
        },)*];
    };
}

faults! {
    loss, 0.0 to 0.5, 0.0, "share of the bytes from sensor to host that are lost";
    burst, 1.0 to 1000.0, 1.0, "mean number of bytes lost in a row, geometric";
    flip, 0.0 to 0.5, 0.0, "share of the bytes in which a run of flipped bits starts";
    flip_bits, 1.0 to 64.0, 1.0, "mean number of neighbouring bits in a run, geometric";
    insert, 0.0 to 0.5, 0.0, "share of the bytes before which random ones are inserted";
    insert_burst, 1.0 to 1000.0, 1.0, "mean number of random bytes in a row, geometric";
    double, 0.0 to 0.5, 0.0, "share of the bytes that arrive twice";
    repeat, 0.0 to 1.0, 0.0, "share of the telegrams that arrive twice; the copy has its own line in the truth file";
    truncate, 0.0 to 1.0, 0.0, "share of the telegrams whose end is lost";
    length, 0.0 to 1.0, 0.0, "share of the telegrams whose length field is changed";
    abort, 0.0 to 1.0, 0.0, "share of the scans that the sensor breaks off by itself";
    flood, 0.0 to 8000.0, 0.0, "bytes of a flood of garbage";
    flood_every, 0.01 to 86400.0, 1.0, "mean seconds between floods";
    wall, 0.0 to 8000.0, 0.0, "bytes of a wall of start bytes: 02, 02 80, or headers like the stream's";
    wall_every, 0.01 to 86400.0, 1.0, "mean seconds between walls";
    inside, 0.0 to 1.0, 0.5, "share of the floods and walls that start inside a telegram";
    silence, 0.0 to 86400.0, 0.0, "seconds for which nothing arrives";
    silence_at, 0.0 to 86400.0, 0.0, "time of the first silence, in seconds; 0: 5, or within silence_every";
    silence_every, 0.0 to 86400.0, 0.0, "mean seconds to the next; 0: once";
    stall, 0.0 to 86400.0, 0.0, "seconds for which everything is held back and then arrives late";
    stall_at, 0.0 to 86400.0, 0.0, "as silence_at";
    stall_every, 0.0 to 86400.0, 0.0, "as silence_every";
    delay, 0.0 to 10.0, 0.0, "greatest random lateness of each piece, in seconds";
    unplug, 0.0 to 86400.0, 0.0, "seconds for which the port is gone";
    unplug_at, 0.0 to 86400.0, 0.0, "as silence_at";
    unplug_every, 0.0 to 86400.0, 0.0, "as silence_every";
    power_at, 0.0 to 86400.0, 0.0, "time of the first power cycle, in seconds; 0: within power_every";
    power_every, 0.0 to 86400.0, 0.0, "mean seconds to the next; 0: once";
    brownout_at, 0.0 to 86400.0, 0.0, "time of the first brown-out, which restarts the sensor, as power_at";
    brownout_every, 0.0 to 86400.0, 0.0, "as power_every";
    hold, 0.0 to 86400.0, 0.0, "of an RPLIDAR: seconds for which something holds its head";
    hold_at, 0.0 to 86400.0, 0.0, "as silence_at";
    hold_every, 0.0 to 86400.0, 0.0, "as silence_every";
    health, 0.0 to 2.0, 0.0, "of an RPLIDAR: status that it reports until a RESET: 1 warning, 2 error";
    stubborn, 0.0 to 1.0, 0.0, "1: a RESET does not change that status";
    id, 0.0 to 255.0, 0.0, "of an RPLIDAR: number that it reports as its model, such as 0x95; 0: that of the model";
    overlook, 0.0 to 1.0, 0.0, "share of the requests that the sensor ignores";
    nak, 0.0 to 1.0, 0.0, "share of the requests that it answers with NAK";
    twice, 0.0 to 1.0, 0.0, "share of the replies that it sends twice";
    late, 0.0 to 60.0, 0.0, "delay of its replies, in seconds";
    late_ack, 0.0 to 60.0, 0.0, "delay of its ACK, in seconds";
    late_mode, 0.0 to 60.0, 0.0, "extra seconds that a change of mode, rate or variant takes";
    late_write, 0.0 to 60.0, 0.0, "extra seconds that a write to the EEPROM takes";
    strict, 0.0 to 1.0, 0.0, "1: in installation mode it refuses to measure";
    strict_gap, 0.0 to 1.0, 0.0, "1: it drops requests whose bytes arrive less than 55 us apart";
    answer, 0.0 to 10.0, 0.0, "seconds from each ACK to its reply; 0: by chance 0.055 to 0.145";
    refuse, 0.0 to 255.0, 0.0, "command that it refuses, such as 0x3B";
    mute, 0.0 to 1.0, 0.0, "1: it does not answer";
    rs232, 0.0 to 1.0, 0.0, "1: the line is RS-232, which carries nothing at 500000 baud or more";
}

impl Faults {
    /// Returns each key, and its meaning, range and default as text.
    pub fn keys() -> impl Iterator<Item = (&'static str, String)> {
        TABLE.iter().map(|key| {
            let Key { name, meaning, least, most, default, .. } = key;
            (*name, format!("{meaning}, {least} to {most} [{default}]"))
        })
    }

    /// Returns the faults that are deviations of the scanner from the protocol.
    pub fn habits(&self) -> Habits {
        Habits {
            overlooks: self.overlook,
            naks: self.nak,
            doubles: self.twice,
            late_acknowledge_ns: (self.late_ack * 1e9) as Nanos,
            late_reply_ns: (self.late * 1e9) as Nanos,
            late_mode_ns: (self.late_mode * 1e9) as Nanos,
            late_write_ns: (self.late_write * 1e9) as Nanos,
            strict: self.strict > 0.0,
            strict_gap: self.strict_gap > 0.0,
            answer_ns: (self.answer * 1e9) as Nanos,
            refuses: if self.refuse > 0.0 { vec![self.refuse as u8] } else { Vec::new() },
            mute: self.mute > 0.0,
        }
    }
}

impl FromStr for Faults {
    type Err = Failure;

    fn from_str(text: &str) -> Result<Self, Failure> {
        let mut faults = Faults::default();
        for part in text.split(',').filter(|part| !part.is_empty()) {
            let (name, value) =
                part.split_once('=').ok_or_else(|| wrong(part, "is not KEY=VALUE", names()))?;
            let key = TABLE.iter().find(|key| key.name == name);
            let Key { least, most, field, .. } = key.ok_or_else(|| wrong(part, "names no fault", names()))?;
            let number = match value.strip_prefix("0x") {
                Some(digits) => u8::from_str_radix(digits, 16).ok().map(f64::from),
                None => value.parse().ok(),
            };
            *field(&mut faults) =
                number.filter(|number| (*least..=*most).contains(number)).ok_or_else(|| {
                    wrong(part, "is out of range", format!("{name} is a number from {least} to {most}"))
                })?;
        }
        Ok(faults)
    }
}

impl fmt::Display for Faults {
    /// Writes the keys that differ from their default, in the form that is parsed. Without faults, writes nothing.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut faults = *self;
        let parts = TABLE.iter().filter_map(|key| {
            let value = *(key.field)(&mut faults);
            (value != key.default).then(|| format!("{}={value}", key.name))
        });
        f.write_str(&parts.collect::<Vec<_>>().join(","))
    }
}

fn wrong(part: &str, what: &str, hint: String) -> Failure {
    Failure::new(Kind::Configuration, format!("fault {part:?} {what}"), hint)
}

fn names() -> String {
    format!("keys: {}", TABLE.iter().map(|key| key.name).collect::<Vec<_>>().join(", "))
}

/// Returns random numbers for one `kind` of fault. Each kind has a separate sequence, so that it does not change the
/// others.
fn random(seed: u64, kind: u64) -> fastrand::Rng {
    fastrand::Rng::with_seed(seed ^ kind.wrapping_mul(0x9E37_79B9_7F4A_7C15))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn written_faults() {
        let faults: Faults = "loss=0.00135,burst=1.89".parse().unwrap();
        assert_eq!(faults, Faults { loss: 0.00135, burst: 1.89, ..Faults::default() });
        assert_eq!(faults.to_string(), "loss=0.00135,burst=1.89");
        assert_eq!(("".parse(), Faults::default().to_string()), (Ok(Faults::default()), String::new()));
        for (text, says) in [
            ("los=0.1", "loss, burst"),
            ("loss", "loss, burst"),
            ("loss=2", "from 0 to 0.5"),
            ("loss=x", "from 0 to 0.5"),
            ("burst=0.5", "from 1 to 1000"),
            ("burst=nan", "from 1 to 1000"),
            ("refuse=0x100", "from 0 to 255"),
        ] {
            let failure = text.parse::<Faults>().unwrap_err();
            assert!(failure.hint.contains(says), "{text}: {failure}");
            assert!(failure.message.contains(text), "{text}: {failure}");
            assert_eq!(failure.kind.exit_code(), 78);
        }
    }

    #[test]
    fn every_key_is_written_and_read_and_is_off_unless_asked_for() {
        for key in TABLE {
            let mut faults = Faults::default();
            assert_eq!(*(key.field)(&mut faults), key.default);
            *(key.field)(&mut faults) = key.most;
            let text = faults.to_string();
            assert_eq!((text.parse(), text), (Ok(faults), format!("{}={}", key.name, key.most)));
        }
        let habits = "overlook=0.5,late=1.5,refuse=0x3B,mute=1".parse::<Faults>().unwrap().habits();
        assert_eq!((habits.overlooks, habits.late_reply_ns), (0.5, 1_500_000_000));
        assert_eq!((habits.refuses, habits.mute), (vec![0x3B], true));
        let habits = "strict_gap=1,answer=0.06".parse::<Faults>().unwrap().habits();
        assert_eq!((habits.strict_gap, habits.answer_ns), (true, 60_000_000));
        let habits = "late_mode=2.5,late_write=6".parse::<Faults>().unwrap().habits();
        assert_eq!((habits.late_mode_ns, habits.late_write_ns), (2_500_000_000, 6_000_000_000));
        assert_eq!(Faults::default().habits(), Habits::default());
    }
}
