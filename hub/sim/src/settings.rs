//! The sensor at the start of a simulation: its type and EEPROM, the state in which an earlier host left it, and its bad
//! habits. Plain values; [`crate::machine`] acts on them.

use scanhub_drivers::lms::variant::{Baud, Mode, Unit, Variant};
use schema::{MILLIS, Nanos};

use crate::operating::Operating;
use crate::transmission::ChunkSize;

/// The sensor at time 0, and the hardware at the host's end of its line.
#[derive(Clone, Debug)]
pub struct Settings {
    /// The sensor's own address, 0 to 127; it answers to this one and to 0.
    pub address: u8,
    /// Its reply to 3Ah: by convention 21 ASCII characters. An LMS 211 sees only 100 degrees.
    pub type_name: String,
    /// Rate of the line. [`Settings::permanent_baud`] and 9600 are what a power cycle brings.
    pub baud: Baud,
    /// Rate at power-on in the EEPROM, written with 66h; `None`: 9600.
    pub permanent_baud: Option<Baud>,
    /// Angle and resolution at power-on.
    pub variant: Variant,
    /// Unit of the ranges, in the EEPROM.
    pub unit: Unit,
    /// How the 16 bits of a value are split, in the EEPROM.
    pub mode: Mode,
    /// Byte 4 of the configuration: bit 1 appends scan and telegram index to measured values.
    pub availability: u8,
    /// Bytes of the configuration: 34, or 32 with older firmware.
    pub configuration_len: usize,
    /// What a host that is gone left it doing.
    pub start: Start,
    /// From power-on to the banner 90h; a real sensor takes up to 60 s.
    pub boot_ns: Nanos,
    /// The byte that ends each reply: 10h for a healthy sensor, 11h after some news (Telegram listing 8).
    pub status: u8,
    /// Pairs of type and number, as in the reply to 32h (Telegram listing, B2h).
    pub errors: Vec<(u8, u8)>,
    /// Transparency of the front window in percent of what it was when clean: a warning below 75, an error below 30.
    pub pollution_percent: u16,
    /// How it deviates from the listing.
    pub habits: Habits,
    /// How many bytes arrive at once.
    pub chunk: ChunkSize,
    /// How many times faster the machine's time runs than the host's, which keeps the gaps of its requests by its own
    /// clock.
    pub speed: f64,
    /// Seed of the delays before replies, and of bad habits.
    pub seed: u64,
}

impl Default for Settings {
    /// An LMS 200 as it left the factory, except for mode 1: millimetres and reflector levels.
    fn default() -> Self {
        Settings {
            address: 0,
            type_name: "LMS200;301063;V02.30 ".into(),
            baud: Baud::B9600,
            permanent_baud: None,
            variant: Variant::HALF,
            unit: Unit::Mm,
            mode: Mode(1),
            availability: 0,
            configuration_len: 34,
            start: Start::In(Operating::OnRequest),
            boot_ns: 2_000 * MILLIS,
            status: 0x10,
            errors: Vec::new(),
            pollution_percent: 100,
            habits: Habits::default(),
            chunk: ChunkSize::Uart,
            speed: 1.0,
            seed: 0,
        }
    }
}

/// What the sensor does at time 0.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Start {
    /// It is through with its start-up, and in this operating mode.
    In(Operating),
    /// It gets its power now: silence, then the banner.
    PowerOn,
}

/// How a sensor deviates from the listing; real ones do so occasionally.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Habits {
    /// Share of the requests that it overlooks while its mirror turns.
    pub overlooks: f64,
    /// Share of the requests that it answers with NAK although they arrived intact.
    pub naks: f64,
    /// Share of the replies that it sends twice.
    pub doubles: f64,
    /// How much later than usual its ACK is sent.
    pub late_acknowledge_ns: Nanos,
    /// How much later than usual its reply is sent; it is sent even if the next request arrives before.
    pub late_reply_ns: Nanos,
    /// How much longer than usual a change of mode, rate or variant takes: up to 3 s by the listing. A request that arrives
    /// before it is done is answered at once, and the reply to the change is never sent.
    pub late_mode_ns: Nanos,
    /// How much longer than usual a write to the EEPROM takes; SICK's quick manual allows 7 s.
    pub late_write_ns: Nanos,
    /// Whether it refuses to measure in installation mode, with 92h: it must first enter the monitoring mode (Telegram
    /// listing 6.3.2; its table 7-1 allows measuring).
    pub strict: bool,
    /// Whether it drops requests whose bytes arrive less than 55 us apart (Telegram listing 4.3); most hosts ignore that
    /// limit.
    pub strict_gap: bool,
    /// How long it thinks between each ACK and its reply; 0: as long as real ones did, by chance.
    pub answer_ns: Nanos,
    /// Commands that it refuses with 92h.
    pub refuses: Vec<u8>,
    /// Whether it does not answer at all. A stream continues.
    pub mute: bool,
}
