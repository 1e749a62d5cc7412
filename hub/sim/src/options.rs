//! Options of `simulate`: their values, the parsers of their texts, and the check of their combination.

use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use scanhub_drivers::ld;
use scanhub_drivers::lms::lms_model::LmsModel;
use scanhub_drivers::lms::variant::{Baud, Mode, Unit, Variant};
use scanhub_schema::{Failure, Kind};

use crate::device::ChunkSize;
use crate::fault::Faults;
use crate::machine::StartState;
use crate::operating::OperatingMode;
use crate::port;
use crate::rplidar;
use crate::world::World;

/// Options of the verb `simulate`.
#[derive(Clone, Debug)]
pub struct SimulateOptions {
    /// Ports of the scanners: the path of the symlink to a pty, or `tcp:HOST:PORT` for a TCP server.
    pub ports: Vec<PathBuf>,
    /// Rate of the line; `None` selects the permanent rate, or 9600 if there is no permanent rate.
    pub baud: Option<Baud>,
    /// Rate at power-on that a previous owner has written into the scanner.
    pub permanent_baud: Option<Baud>,
    /// Address of the scanners, 0 to 127.
    pub address: u8,
    /// State in which an earlier host left the scanners.
    pub state: StartState,
    /// Time from power-on to the boot message.
    pub boot: Duration,
    /// The byte that ends each reply.
    pub status: u8,
    /// Errors in the reply to 32h: type and number.
    pub errors: Vec<(u8, u8)>,
    /// Transparency of the front window in percent.
    pub pollution: u16,
    /// Whether measured values end with scan and telegram index.
    pub indices: bool,
    /// Whether the configuration has 32 bytes, as with older firmware.
    pub short_configuration: bool,
    /// Surroundings of the scanners. A scanner that replays a recording does not use them.
    pub world: World,
    /// Recording to send instead of scans of a world.
    pub replay: Option<PathBuf>,
    /// Sensors of the recording that the ports play: one sensor for all ports, or one for each port. It may be empty if
    /// the recording has only one sensor.
    pub sensors: Vec<String>,
    /// Whether the recording restarts at its end.
    pub looped: bool,
    /// Speed of the scanner's time relative to the clock, including the bit time: 0.01 to 100.
    pub speed: f64,
    /// Seed of worlds, delays and faults. For delays and faults, the index of the port is added. For worlds, see
    /// [`Room::of_port`](crate::room::Room::of_port).
    pub seed: u64,
    /// Faults of the line.
    pub faults: Faults,
    /// Path of the truth file.
    pub truth: Option<PathBuf>,
    /// Whether to replace an existing truth file.
    pub force: bool,
    /// Type that the scanners report, which limits what they support.
    pub family: LmsModel,
    /// Angle and resolution; `None` selects the values of the recording. Without a recording, it selects the values of
    /// the type.
    pub variant: Option<Variant>,
    /// Unit; `None` selects the unit of the recording. Without a recording, it selects the unit of the type.
    pub unit: Option<Unit>,
    /// Measuring mode; `None` selects the mode of the recording. Without a recording, it selects 0x01.
    pub mode: Option<Mode>,
    /// Number of bytes that the host's hardware delivers at once.
    pub chunk: ChunkSize,
    /// Whether the scanners wait while the host's buffer is full. Otherwise bytes are lost, as on a real line.
    pub lossless: bool,
    /// Scanner of another family; `None` means an LMS. For another family, options that only an LMS has must have their
    /// defaults.
    pub scanner: Option<Scanner>,
}

/// A scanner of another family than LMS.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scanner {
    /// An LDROBOT.
    Ld(ld::Model),
    /// An RPLIDAR.
    Rplidar {
        /// The model.
        model: rplidar::Model,
        /// Index of the mode that the scanner recommends. If an earlier host has started a stream, the stream is in
        /// this mode, too.
        mode: usize,
    },
}

impl Scanner {
    /// Returns the name of the model in options.
    pub fn name(self) -> &'static str {
        match self {
            Scanner::Ld(model) => model.name(),
            Scanner::Rplidar { model, .. } => model.name(),
        }
    }
}

impl Default for SimulateOptions {
    /// Returns the defaults of the verb, without a port.
    fn default() -> Self {
        SimulateOptions {
            ports: Vec::new(),
            baud: None,
            permanent_baud: None,
            address: 0,
            state: StartState::Operating(OperatingMode::OnRequest),
            boot: Duration::from_secs(2),
            status: 0x10,
            errors: Vec::new(),
            pollution: 100,
            indices: false,
            short_configuration: false,
            world: "room".parse().expect("a built-in scene"),
            replay: None,
            sensors: Vec::new(),
            looped: false,
            speed: 1.0,
            seed: 0,
            faults: Faults::default(),
            truth: None,
            force: false,
            family: LmsModel::Lms200,
            variant: None,
            unit: None,
            mode: None,
            chunk: ChunkSize::Uart,
            lossless: false,
            scanner: None,
        }
    }
}

impl SimulateOptions {
    /// Checks that every value is in its range, and that no two options contradict each other.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`] if a value is out of range, or if options contradict each other.
    pub(crate) fn check(&self) -> Result<(), Failure> {
        let invalid = |message: String, hint: &str| Err(Failure::new(Kind::Configuration, message, hint));
        if self.ports.is_empty() {
            return invalid("no port to simulate".into(), "name one with --port PATH or --tcp HOST:PORT");
        }
        for (number, port) in self.ports.iter().enumerate() {
            let is_any = port::server(port).is_some_and(|address| address.ends_with(":0"));
            if self.ports[..number].contains(port) && !is_any {
                return invalid(
                    format!("port {} is named twice", port.display()),
                    "give each scanner its own port",
                );
            }
        }
        if !(0.01..=100.0).contains(&self.speed) {
            return invalid(format!("speed {} is out of range", self.speed), "a number from 0.01 to 100");
        }
        if self.address > 127 {
            return invalid(format!("address {} is out of range", self.address), "a number from 0 to 127");
        }
        if self.pollution > 100 {
            return invalid(format!("pollution {} is out of range", self.pollution), "percent, 0 to 100");
        }
        if let Some(scanner) = self.scanner {
            let talks = matches!(scanner, Scanner::Rplidar { .. });
            let states = [
                StartState::Operating(OperatingMode::OnRequest),
                StartState::Operating(OperatingMode::All),
                StartState::PowerOn,
            ];
            let lms = [
                ("baud", self.baud.is_some() || self.permanent_baud.is_some()),
                ("variant", self.variant.is_some()),
                ("unit", self.unit.is_some()),
                ("mode by number", self.mode.is_some()),
                ("state", self.state != states[0] && !(talks && states.contains(&self.state))),
                ("sensor", !self.sensors.is_empty() && talks),
                ("type", self.family != SimulateOptions::default().family),
                ("address", self.address != 0),
                ("pollution", self.pollution != 100),
                ("status byte", self.status != SimulateOptions::default().status),
                ("error", !self.errors.is_empty()),
                ("indices", self.indices || self.short_configuration),
                ("recording", self.replay.is_some() && talks),
            ];
            if let Some((name, _)) = lms.into_iter().find(|(_, is_set)| *is_set) {
                let message = format!("a scanner {} has no {name} to choose", scanner.name());
                let hint = match name {
                    "state" if talks => "use idle, streaming or starting, or --family lms",
                    _ => "leave it out, or use --family lms",
                };
                return invalid(message, hint);
            }
        }
        if let (Some(variant), family) = (self.variant, self.family)
            && let Some(reason) = family.refuses_variant(variant)
        {
            let Variant { angle_deg, resolution_cdeg } = variant;
            let message = format!(
                "an {} cannot scan {angle_deg}/{}",
                family.name(),
                f64::from(resolution_cdeg) / 100.0
            );
            return invalid(message, reason);
        }
        let tells_all = |start: &StartState| match start {
            StartState::Operating(operating) => *operating == OperatingMode::All || !operating.streams(),
            StartState::PowerOn => true,
        };
        if self.replay.is_some() && !tells_all(&self.state) {
            return invalid(
                "a recording is sent in whole scans only".into(),
                "leave --state out, or use idle, streaming, installation or starting",
            );
        }
        if !self.sensors.is_empty() && self.replay.is_none() {
            return invalid("--sensor without a recording".into(), "name one with --replay FILE");
        }
        if self.sensors.len() > 1 && self.sensors.len() != self.ports.len() {
            let message = format!("{} sensors for {} ports", self.sensors.len(), self.ports.len());
            return invalid(message, "name one --sensor for all ports, or one for each");
        }
        if self.looped && self.replay.is_none() {
            return invalid("--loop without a recording".into(), "name one with --replay FILE");
        }
        Ok(())
    }
}

/// Returns type, number and firmware as a scanner of `family` reports them: 21 characters (Telegram listing, BAh).
pub fn type_name(family: LmsModel) -> String {
    format!("{};301063;V02.30 ", family.name().to_uppercase())
}

/// Returns the scanner that `family`, `model` and the name of a `mode` select. Returns `None` for an LMS, whose models
/// are types and whose modes are numbers.
pub fn parse_family(
    family: &str,
    model: Option<&str>,
    mode: Option<&str>,
) -> Result<Option<Scanner>, Failure> {
    let invalid = |message: String, hint: &str| Err(Failure::new(Kind::Configuration, message, hint));
    let model = model.map(str::to_lowercase);
    match one_of("family", family, &["lms", "ld", "rplidar"].map(|name| (name, name)))? {
        "ld" => {
            if let Some(mode) = mode {
                return invalid(
                    format!("mode {mode:?} of family \"ld\""),
                    "leave --mode out: LDROBOT scanners have only one way to measure",
                );
            }
            let models = ld::Model::ALL.map(|model| (model.name(), Scanner::Ld(model)));
            one_of("model", model.as_deref().unwrap_or(ld::Model::Ld19.name()), &models).map(Some)
        }
        "rplidar" => {
            let models = rplidar::Model::ALL.map(|model| (model.name(), model));
            let model = one_of("model", model.as_deref().unwrap_or(rplidar::Model::A1.name()), &models)?;
            let modes: Vec<_> = model.modes().iter().map(|mode| mode.name.to_lowercase()).collect();
            let named = |wanted: &str| modes.iter().position(|name| *name == wanted.to_lowercase());
            let mode = match mode.map(|mode| (mode, named(mode))) {
                None => model.typical(),
                Some((_, Some(mode))) => mode,
                Some((mode, None)) => {
                    let hint = format!("one of: {}", modes.join(", "));
                    return invalid(format!("a scanner {} has no mode {mode:?}", model.name()), &hint);
                }
            };
            Ok(Some(Scanner::Rplidar { model, mode }))
        }
        _ => match model {
            None => Ok(None),
            Some(model) => {
                let hint = "--type says which LMS; --model is for the families ld and rplidar";
                invalid(format!("model {model:?} of family \"lms\""), hint)
            }
        },
    }
}

/// Parses a type of LMS that has a factory variant, such as `lms200`.
pub fn parse_type(text: &str) -> Result<LmsModel, Failure> {
    let families = LmsModel::ALL.into_iter().filter(|family| family.factory_variant().is_some());
    one_of("type", text, &families.map(|family| (family.name(), family)).collect::<Vec<_>>())
}

/// Parses the state in which an earlier host left the scanner: `idle`, `streaming`, another mode that streams,
/// `installation`, or `starting` for a scanner that is switched on now.
pub fn parse_state(text: &str) -> Result<StartState, Failure> {
    let known = [
        ("idle", StartState::Operating(OperatingMode::OnRequest)),
        ("streaming", StartState::Operating(OperatingMode::All)),
        ("partial", StartState::Operating(OperatingMode::Partial)),
        ("means", StartState::Operating(OperatingMode::Means(10))),
        ("range", StartState::Operating(OperatingMode::Range(31, 91))),
        ("mean-range", StartState::Operating(OperatingMode::MeanRange(10, 31, 91))),
        ("fields", StartState::Operating(OperatingMode::Fields(1, 100))),
        ("reflectivity", StartState::Operating(OperatingMode::Reflectivity(vec![(1, 101)]))),
        ("installation", StartState::Operating(OperatingMode::Installation)),
        ("starting", StartState::PowerOn),
    ];
    one_of("state", text, &known)
}

/// Parses an error as in a reply to 32h: type and number, such as `0x84:22`.
pub fn parse_error(text: &str) -> Result<(u8, u8), Failure> {
    let pair = text.split_once(':').and_then(|(kind, number)| Some((byte(kind)?, byte(number)?)));
    pair.ok_or_else(|| {
        let hint = "write TYPE:NUMBER, such as 3:18, or 0x84:22 for a fatal error of the past";
        Failure::new(Kind::Configuration, format!("error {text:?} is not TYPE:NUMBER"), hint)
    })
}

/// Parses a byte, such as `0x10` or `16`. `what` names the option in the error.
pub fn parse_byte(what: &str, text: &str) -> Result<u8, Failure> {
    byte(text).ok_or_else(|| {
        Failure::new(
            Kind::Configuration,
            format!("{what} {text:?} is not a byte"),
            "use 0 to 255, or 0x00 to 0xFF",
        )
    })
}

fn byte(text: &str) -> Option<u8> {
    match text.strip_prefix("0x").or(text.strip_prefix("0X")) {
        Some(digits) => u8::from_str_radix(digits, 16).ok(),
        None => text.parse().ok(),
    }
}

impl FromStr for ChunkSize {
    type Err = Failure;

    fn from_str(text: &str) -> Result<Self, Failure> {
        one_of("chunk", text, &[("uart", ChunkSize::Uart), ("usb", ChunkSize::Usb)])
    }
}

/// Parses a variant: the angle of the scan and the angle between beams, both in degrees, such as `180/0.5`.
pub fn parse_variant(text: &str) -> Result<Variant, Failure> {
    let names = ["180/1", "180/0.5", "100/1", "100/0.5", "100/0.25"];
    let named: Vec<(&str, Variant)> = names.into_iter().zip(Variant::ALL).collect();
    one_of("variant", text, &named)
}

/// Parses `mm`, `cm` or `dm`.
pub fn parse_unit(text: &str) -> Result<Unit, Failure> {
    one_of("unit", text, &[("mm", Unit::Mm), ("cm", Unit::Cm), ("dm", Unit::Dm)])
}

/// Parses `9600` or another rate of an LMS.
pub fn parse_baud(text: &str) -> Result<Baud, Failure> {
    let named =
        [("9600", Baud::B9600), ("19200", Baud::B19200), ("38400", Baud::B38400), ("500000", Baud::B500000)];
    one_of("baud", text, &named)
}

/// Parses a measuring mode, such as `0x01` or `1`.
pub fn parse_mode(text: &str) -> Result<Mode, Failure> {
    byte(text).filter(|mode| MODES.contains(mode)).map(Mode).ok_or_else(|| {
        let hint = format!("one of: {}", MODES.map(|mode| format!("{mode:#04x}")).join(", "));
        Failure::new(Kind::Configuration, format!("mode {text:?} is not a measuring mode with ranges"), hint)
    })
}

fn one_of<T: Clone>(what: &str, text: &str, known: &[(&str, T)]) -> Result<T, Failure> {
    known.iter().find(|(name, _)| *name == text).map(|(_, value)| value.clone()).ok_or_else(|| {
        let names: Vec<&str> = known.iter().map(|(name, _)| *name).collect();
        Failure::new(
            Kind::Configuration,
            format!("{what} {text:?} is not known"),
            format!("one of: {}", names.join(", ")),
        )
    })
}

/// Family of the scanners, unless an option names another family.
pub const DEFAULT_FAMILY: &str = "lms";
/// Type of the scanners of family `lms`, unless an option names another type.
pub const DEFAULT_TYPE: &str = "lms200";
/// Measuring modes whose values contain a range (Telegram listing, 77h block D).
const MODES: [u8; 8] = [0x00, 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_values_and_rejects_others() {
        assert_eq!(parse_variant("180/0.5").unwrap(), Variant::HALF);
        assert_eq!(parse_variant("100/0.25").unwrap().beams(), 401);
        assert_eq!((parse_mode("0x0F").unwrap(), parse_mode("1").unwrap()), (Mode(15), Mode(1)));
        assert_eq!(parse_unit("cm").unwrap(), Unit::Cm);
        assert_eq!(parse_baud("500000").unwrap().rate(), 500_000);
        let family = |family, model, mode| parse_family(family, model, mode).unwrap();
        assert_eq!(family("lms", None, None), None);
        assert_eq!(family("lms", None, Some("0x01")), None);
        assert_eq!(family("ld", None, None), Some(Scanner::Ld(ld::Model::Ld19)));
        assert_eq!(family("ld", Some("stl27l"), None), Some(Scanner::Ld(ld::Model::Stl27l)));
        let rplidar = |model, mode| Some(Scanner::Rplidar { model, mode });
        assert_eq!(family("rplidar", None, None), rplidar(rplidar::Model::A1, 3));
        assert_eq!(family("rplidar", Some("s3"), Some("ultradense")), rplidar(rplidar::Model::S3, 2));
        assert!(parse_family("lms", Some("ld19"), None).unwrap_err().hint.contains("--type"));
        assert!(parse_family("ld", None, Some("boost")).is_err());
        assert_eq!("usb".parse::<ChunkSize>().unwrap().bytes(), 62);
        for family in [LmsModel::Lms200, LmsModel::Lms211, LmsModel::Lms221, LmsModel::Lms291] {
            let name = type_name(family);
            assert_eq!((LmsModel::of_type(name.as_bytes()), name.len()), (Some(family), 21));
            assert_eq!(parse_type(family.name()).unwrap(), family);
        }
        assert_eq!(parse_state("partial").unwrap(), StartState::Operating(OperatingMode::Partial));
        assert_eq!((parse_error("0x84:22").unwrap(), parse_byte("status", "0x11").unwrap()), ((132, 22), 17));
        for failure in [parse_error("22").unwrap_err(), parse_byte("status", "256").unwrap_err()] {
            assert!(failure.kind.exit_code() == 78 && !failure.hint.is_empty(), "{failure}");
        }
        for failure in [
            parse_variant("180/0.25").unwrap_err(),
            parse_unit("m").unwrap_err(),
            parse_mode("0x3F").unwrap_err(),
            parse_mode("x").unwrap_err(),
            parse_baud("115200").unwrap_err(),
            parse_type("s300").unwrap_err(),
            parse_type("s14").unwrap_err(),
            parse_state("asleep").unwrap_err(),
            parse_family("velodyne", None, None).unwrap_err(),
            parse_family("ld", Some("ld20"), None).unwrap_err(),
            parse_family("rplidar", Some("a9"), None).unwrap_err(),
            parse_family("rplidar", Some("c1"), Some("boost")).unwrap_err(),
        ] {
            assert!(failure.hint.starts_with("one of: ") && failure.kind.exit_code() == 78, "{failure}");
        }
    }
}
