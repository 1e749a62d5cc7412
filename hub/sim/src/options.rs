//! What can be said to `simulate`, and the forms in which it is written. Whether the values fit together is seen by
//! [`crate::simulate`].

use std::path::PathBuf;
use std::str::FromStr;

use lms::variant::{Baud, Mode, Unit, Variant};
use schema::{Failure, Kind};

use crate::fault::Faults;
use crate::room::World;
use crate::transmission::ChunkSize;

/// The options of the verb.
#[derive(Clone, Debug)]
pub struct SimulateOptions {
    /// One sensor each: where the symlink to its pty is to be.
    pub ports: Vec<PathBuf>,
    /// Rate of the line at power-on.
    pub baud: Baud,
    /// What the sensors see, unless they replay.
    pub world: World,
    /// A recording to send instead.
    pub replay: Option<PathBuf>,
    /// Whether the recording begins anew at its end.
    pub looped: bool,
    /// How many times faster than the clock the sensor's time runs, the bit time too; 0.01 to 100.
    pub speed: f64,
    /// Seed of worlds, delays and faults; each port adds its number.
    pub seed: u64,
    /// What goes wrong on the line.
    pub faults: Faults,
    /// File for the truth.
    pub truth: Option<PathBuf>,
    /// What the sensor calls itself.
    pub model: Model,
    /// Angle and resolution; `None`: those of the recording, else 180/0.5.
    pub variant: Option<Variant>,
    /// Unit; `None`: that of the recording, else mm.
    pub unit: Option<Unit>,
    /// Measuring mode; `None`: that of the recording, else 0x01.
    pub mode: Option<Mode>,
    /// How many bytes the host's hardware hands over at once.
    pub chunk: ChunkSize,
}

impl Default for SimulateOptions {
    /// No port; everything else as the verb has it.
    fn default() -> Self {
        SimulateOptions {
            ports: Vec::new(),
            baud: Baud::B9600,
            world: World::Room,
            replay: None,
            looped: false,
            speed: 1.0,
            seed: 0,
            faults: Faults::default(),
            truth: None,
            model: Model::Lms200,
            variant: None,
            unit: None,
            mode: None,
            chunk: ChunkSize::Uart,
        }
    }
}

/// The members of the family; they differ here in what they answer to 3Ah.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Model {
    /// Indoors.
    Lms200,
    /// Outdoors, 100 degrees.
    Lms211,
    /// Outdoors.
    Lms221,
    /// Indoors, long range.
    Lms291,
}

impl Model {
    /// Every model with its name on the command line.
    pub const ALL: [(&str, Model); 4] = [
        ("lms200", Model::Lms200),
        ("lms211", Model::Lms211),
        ("lms221", Model::Lms221),
        ("lms291", Model::Lms291),
    ];

    /// Type, number and firmware as the sensor says them: 21 characters (Telegram listing, BAh).
    pub fn type_name(self) -> &'static str {
        match self {
            Model::Lms200 => "LMS200;301063;V02.30 ",
            Model::Lms211 => "LMS211;301063;V02.30 ",
            Model::Lms221 => "LMS221;301063;V02.30 ",
            Model::Lms291 => "LMS291;301063;V02.30 ",
        }
    }
}

impl FromStr for Model {
    type Err = Failure;

    fn from_str(text: &str) -> Result<Self, Failure> {
        one_of("type", text, &Model::ALL)
    }
}

impl FromStr for ChunkSize {
    type Err = Failure;

    fn from_str(text: &str) -> Result<Self, Failure> {
        one_of("chunk", text, &[("uart", ChunkSize::Uart), ("usb", ChunkSize::Usb)])
    }
}

/// `180/0.5` and its kind: degrees, and degrees between beams.
pub fn parse_variant(text: &str) -> Result<Variant, Failure> {
    let names = ["180/1", "180/0.5", "100/1", "100/0.5", "100/0.25"];
    let named: Vec<(&str, Variant)> = names.into_iter().zip(Variant::ALL).collect();
    one_of("variant", text, &named)
}

/// `mm`, `cm` or `dm`.
pub fn parse_unit(text: &str) -> Result<Unit, Failure> {
    one_of("unit", text, &[("mm", Unit::Mm), ("cm", Unit::Cm), ("dm", Unit::Dm)])
}

/// `9600` and the other rates of the sensor.
pub fn parse_baud(text: &str) -> Result<Baud, Failure> {
    let named =
        [("9600", Baud::B9600), ("19200", Baud::B19200), ("38400", Baud::B38400), ("500000", Baud::B500000)];
    one_of("baud", text, &named)
}

/// The measuring mode, `0x01` or `1`.
pub fn parse_mode(text: &str) -> Result<Mode, Failure> {
    let number = match text.strip_prefix("0x").or(text.strip_prefix("0X")) {
        Some(digits) => u8::from_str_radix(digits, 16),
        None => text.parse(),
    };
    number.ok().filter(|mode| MODES.contains(mode)).map(Mode).ok_or_else(|| {
        let hint = format!("one of: {}", MODES.map(|mode| format!("{mode:#04x}")).join(", "));
        Failure::new(Kind::Configuration, format!("mode {text:?} is none of a range"), hint)
    })
}

fn one_of<T: Copy>(what: &str, text: &str, known: &[(&str, T)]) -> Result<T, Failure> {
    known.iter().find(|(name, _)| *name == text).map(|&(_, value)| value).ok_or_else(|| {
        let names: Vec<&str> = known.iter().map(|&(name, _)| name).collect();
        Failure::new(
            Kind::Configuration,
            format!("{what} {text:?} is not known"),
            format!("one of: {}", names.join(", ")),
        )
    })
}

impl FromStr for World {
    type Err = Failure;

    fn from_str(text: &str) -> Result<Self, Failure> {
        one_of("world", text, &World::ALL)
    }
}

/// Measuring modes whose values hold a range (Telegram listing, 77h block D).
const MODES: [u8; 8] = [0x00, 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn written_values_and_what_is_said_to_others() {
        assert_eq!(parse_variant("180/0.5").unwrap(), Variant::HALF);
        assert_eq!(parse_variant("100/0.25").unwrap().beams(), 401);
        assert_eq!((parse_mode("0x0F").unwrap(), parse_mode("1").unwrap()), (Mode(15), Mode(1)));
        assert_eq!(parse_unit("cm").unwrap(), Unit::Cm);
        assert_eq!(parse_baud("500000").unwrap().rate(), 500_000);
        assert_eq!("usb".parse::<ChunkSize>().unwrap().bytes(), 62);
        for (name, model) in Model::ALL {
            assert!(model.type_name().starts_with(&name.to_uppercase()) && model.type_name().len() == 21);
        }
        for failure in [
            parse_variant("180/0.25").unwrap_err(),
            parse_unit("m").unwrap_err(),
            parse_mode("0x3F").unwrap_err(),
            parse_mode("x").unwrap_err(),
            parse_baud("115200").unwrap_err(),
            "s300".parse::<Model>().unwrap_err(),
            "moon".parse::<World>().unwrap_err(),
        ] {
            assert!(failure.hint.starts_with("one of: ") && failure.kind.exit_code() == 78, "{failure}");
        }
    }
}
