//! Descriptions of a scanner that was found, as text and as JSON of class `probe`: [`Description`] of an LMS, and
//! [`RotatingDescription`] of a rotating scanner.

use std::fmt;

use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::configuration::availability_text;
use scanhub_drivers::lms::lms_model::LmsModel as Type;
use scanhub_drivers::lms::operating;
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::status::StatusByte;
use scanhub_drivers::lms::variant::Mode;
use scanhub_drivers::{Model, Report, features, lms};
use scanhub_schema::{Family, Status};
use serde::Serialize;

use crate::driver::DetectedScanner;

/// The scanner at a port.
#[derive(Clone, Debug, Serialize)]
#[serde(untagged)]
pub(super) enum FoundDescription {
    /// A scanner that reports its settings on request.
    Reported(Box<Description>),
    /// A rotating scanner.
    Rotating(Box<RotatingDescription>),
}

impl fmt::Display for FoundDescription {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            FoundDescription::Reported(description) => description.fmt(f),
            FoundDescription::Rotating(turning) => turning.fmt(f),
        }
    }
}

/// Returns the settings of a link for the LMS that sent `report`, at a line of `rate` bits per second.
pub(crate) fn link_settings(report: &Report, rate: u32) -> Vec<(&'static str, String)> {
    let kind = report.kind().and_then(Type::of_type);
    // A configuration cannot name a type that has no factory variant, but the hub also streams from such a scanner if
    // the type is not configured.
    let kind = kind.filter(|kind| kind.factory_variant().is_some());
    let mut settings = vec![("family", Family::Lms.name().to_owned())];
    settings.extend(kind.map(|kind| ("type", kind.name().to_owned())));
    settings.extend((rate != features(Family::Lms).defaults.baud).then(|| ("baud", rate.to_string())));
    settings
}

/// Description of an LMS. A value that the scanner did not report is null.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Description {
    class: &'static str,
    port: String,
    family: &'static str,
    model: Option<String>,
    baud: Option<u32>,
    #[serde(rename = "type")]
    kind: Option<String>,
    number: Option<String>,
    firmware: Option<String>,
    address: Option<u8>,
    operating_mode: Option<u8>,
    mode: Option<u8>,
    unit_mm: Option<u8>,
    angle_deg: Option<u16>,
    step_deg: Option<f64>,
    /// Whether the scanner uses another rate than 9600 Bd after power-on.
    permanent_rate: Option<bool>,
    defective: Option<bool>,
    condition: Option<String>,
    polluted: Option<bool>,
    /// Transmission of the window, in percent; only the text has it.
    #[serde(skip)]
    window_percent: Option<u16>,
    laser_on: Option<bool>,
    availability: Option<u8>,
    errors: Option<Vec<Fault>>,
    hours: Option<u32>,
    power_ons: Option<u16>,
    /// The first part of the configuration in hex. `configure` can restore it.
    configuration: Option<String>,
}

#[derive(Clone, Debug, Serialize)]
struct Fault {
    severity: Option<&'static str>,
    number: u8,
    past: bool,
    meaning: Option<&'static str>,
}

impl Description {
    /// Creates the description of the LMS at `port` from its `report`.
    pub(super) fn new(port: String, report: &Report) -> Description {
        let kind = report.kind().map(|kind| String::from_utf8_lossy(kind).into_owned());
        let mut words = kind.iter().flat_map(|kind| kind.split(';')).map(|word| word.trim().to_owned());
        let (kind, number, firmware) = (words.next(), words.next(), words.next());
        let status = report.status();
        let variant = status.and_then(|status| status.variant());
        let condition = report.status_byte.map(StatusByte);
        let configuration = report.configuration();
        let faults = |fault: lms::status::Fault| Fault {
            severity: fault.severity().map(|severity| severity.name()),
            number: fault.number,
            past: fault.is_past(),
            meaning: fault.meaning(),
        };
        let (hours, power_ons) = match report.reply(Request::Counters) {
            Some(Reply::Counters { hours_by_2, power_ons }) => {
                (Some(2 * u32::from(hours_by_2)), Some(power_ons))
            }
            _ => (None, None),
        };
        Description {
            class: "probe",
            port,
            family: Family::Lms.name(),
            model: kind.as_deref().map(str::to_lowercase),
            baud: report.baud.map(|baud| baud.rate()),
            kind,
            number,
            firmware: firmware
                .or(status.map(|status| String::from_utf8_lossy(status.software()).into_owned())),
            address: report.address,
            operating_mode: status.map(|status| status.operating_mode()),
            mode: status.map(|status| status.mode().0),
            unit_mm: status.and_then(|status| status.unit()).map(|unit| unit.mm()),
            angle_deg: variant.map(|variant| variant.angle_deg),
            step_deg: variant.map(|variant| f64::from(variant.resolution_cdeg) / 100.0),
            permanent_rate: status.map(|status| status.has_permanent_baud()),
            defective: status.map(|status| status.is_defective()),
            condition: condition.map(|condition| condition.to_string()),
            polluted: report.is_polluted(),
            window_percent: status.and_then(|status| status.window_percent()),
            laser_on: status.map(|status| status.is_laser_on()),
            availability: configuration.map(|configuration| configuration.availability()),
            errors: report.errors().map(|errors| errors.iter().map(faults).collect()),
            hours,
            power_ons,
            configuration: configuration.map(|configuration| hex(configuration.bytes())),
        }
    }
}

impl fmt::Display for Description {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut row = |label: &str, value: Option<String>| match value {
            Some(value) => writeln!(f, "  {label:<16}{value}"),
            None => Ok(()),
        };
        let (kind, number) = (self.kind.as_deref(), self.number.as_deref());
        row("family", Some(self.family.to_owned()))?;
        row("type", kind.map(|kind| format!("{kind}, number {}", number.unwrap_or("not reported"))))?;
        row("firmware", self.firmware.clone())?;
        row("rate", self.baud.map(|baud| format!("{baud} Bd")))?;
        let power_on = |permanent| if permanent { "as set in its EEPROM, not 9600 Bd" } else { "9600 Bd" };
        row("after power-on", self.permanent_rate.map(|permanent| power_on(permanent).to_owned()))?;
        row("address", self.address.map(|address| address.to_string()))?;
        row(
            "operating mode",
            self.operating_mode.map(|mode| format!("{mode:02x}h, {}", operating::name(mode))),
        )?;
        row("measuring mode", self.mode.map(|mode| format!("{mode:02x}h, {}", describe_mode(Mode(mode)))))?;
        row("unit", self.unit_mm.map(|mm| format!("{mm} mm")))?;
        let view = self.angle_deg.zip(self.step_deg);
        row("view", view.map(|(angle, step)| format!("{angle} degrees in steps of {step}")))?;
        row("availability", self.availability.map(|byte| availability_text(byte).to_owned()))?;
        let defect = if self.defective == Some(true) { "reports that it is defective; " } else { "" };
        let dirty = self.polluted == Some(true);
        let condition = |condition: &String| {
            let pollution = if dirty && !condition.contains("polluted") { ", window polluted" } else { "" };
            format!("{defect}{condition}{pollution}")
        };
        row("condition", self.condition.as_ref().map(condition))?;
        let remedy = if dirty { ": clean it" } else { "" };
        let window = |percent| format!("{percent} % clear{remedy}");
        row("window", self.window_percent.map(window))?;
        row("laser", self.laser_on.map(|on| if on { "on" } else { "off" }.to_owned()))?;
        row("hours", self.hours.map(|hours| hours.to_string()))?;
        row("power-ons", self.power_ons.map(|count| count.to_string()))?;
        let errors = self.errors.as_deref();
        row("errors", errors.map(|errors| if errors.is_empty() { "none" } else { "" }.to_owned()))?;
        for fault in errors.unwrap_or_default() {
            let past = if fault.past { "past " } else { "" };
            let (severity, meaning) =
                (fault.severity.unwrap_or("unknown"), fault.meaning.unwrap_or_default());
            row("", Some(format!("{past}{severity} {}: {meaning}", fault.number)))?;
        }
        row("configuration", self.configuration.clone())
    }
}

/// Returns the meaning of the bits of a value in measuring `mode` (Telegram listing, 77h block D).
pub(crate) fn describe_mode(mode: Mode) -> String {
    let upper = match (mode.0, mode.intensity_bits()) {
        (0x00, _) => "fields A and B, dazzle",
        (0x02, _) => "fields A, B and C",
        (0x04, _) => "fields A and B",
        (0x06, _) => "field A",
        (0x0F, _) => "no other bits",
        (0x3F, _) => return "energy instead of ranges".to_owned(),
        (_, 3) => "8 levels of reflectors",
        (_, 2) => "4 levels of reflectors",
        (_, 1) => "reflector or not",
        _ => return "reserved".to_owned(),
    };
    format!("{} bits of range, {upper}", mode.range_bits())
}

/// Formats `bytes` as lowercase hex without spaces.
pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Description of a rotating scanner. An unknown value is null.
#[derive(Clone, Debug, Serialize)]
pub(super) struct RotatingDescription {
    class: &'static str,
    port: String,
    family: &'static str,
    /// Name of the model, or a number such as `0x95` if scanhub does not know the model.
    model: Option<String>,
    baud: u32,
    /// Firmware and serial number, as text.
    identity: Option<String>,
    /// Health that the scanner reports, as text.
    health: Option<String>,
    /// Number of packets with measured data, within about a second.
    packets: Option<u64>,
    /// Share of bytes that belong to no packet.
    damaged: Option<f64>,
    points_per_second: Option<f64>,
    revolutions_per_second: Option<f64>,
    problem: Option<String>,
}

impl RotatingDescription {
    /// Creates the description of the `scanner` that was detected at `port`.
    pub(crate) fn new(port: String, scanner: &DetectedScanner) -> RotatingDescription {
        let rounded = |value: f64| (value > 0.0).then(|| (value * 100.0).round() / 100.0);
        let is_received = scanner.packets > 0 || scanner.introduction.is_none();
        RotatingDescription {
            class: "probe",
            port,
            family: scanner.family.name(),
            model: scanner.model_text.clone(),
            baud: scanner.rate,
            identity: scanner.introduction.as_ref().map(|introduction| introduction.identity.clone()),
            health: scanner
                .introduction
                .as_ref()
                .map(|introduction| introduction.health.clone())
                .filter(|words| !words.is_empty()),
            packets: is_received.then_some(scanner.packets),
            damaged: is_received.then(|| scanner.damaged()),
            points_per_second: rounded(scanner.points_per_second),
            revolutions_per_second: rounded(scanner.revolutions_per_second),
            // If the line damages bytes, any other problem may be a consequence.
            problem: scanner.line_problem().or_else(|| scanner.problem.clone()),
        }
    }

    /// Returns the models that cannot be distinguished from this scanner. Returns an empty string if the scanner has
    /// identified itself.
    fn similar_models(&self) -> String {
        let features = Family::parse(self.family).map(features);
        let models = features.map_or(&[][..], |features| features.models);
        let found = models.iter().find(|model| Some(model.name) == self.model.as_deref());
        let Some(found) = found.filter(|_| self.identity.is_none()) else { return String::new() };
        let is_similar = |model: &&Model| {
            model.name != found.name && (model.baud, model.beams) == (found.baud, found.beams)
        };
        let names: Vec<_> = models.iter().filter(is_similar).map(|model| model.name).collect();
        if names.is_empty() { String::new() } else { format!(" (or {}: same protocol)", names.join(", ")) }
    }
}

impl fmt::Display for RotatingDescription {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut row = |label: &str, value: Option<String>| match value {
            Some(value) => writeln!(f, "  {label:<16}{value}"),
            None => Ok(()),
        };
        row("family", Some(self.family.to_owned()))?;
        row(
            "model",
            self.model
                .as_ref()
                .map(|model| format!("{}{}", Status::display_model(model), self.similar_models())),
        )?;
        row("rate", Some(format!("{} Bd", self.baud)))?;
        row("identity", self.identity.clone())?;
        row("health", self.health.clone())?;
        let received = self.packets.zip(self.damaged);
        row(
            "packets",
            received.map(|(packets, damaged)| {
                format!("{packets}, {:.1} % of the bytes damaged", 100.0 * damaged)
            }),
        )?;
        row("points", self.points_per_second.map(|points| format!("{points:.0} per second")))?;
        row("speed", self.revolutions_per_second.map(|speed| format!("{speed:.2} revolutions per second")))?;
        row("problem", self.problem.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_drivers::identity_probe;

    #[test]
    fn link_names_only_a_rate_below_the_highest() {
        let report = identity_probe(Family::Lms, None, 0).unwrap().report().clone();
        let family = ("family", "lms".to_owned());
        assert_eq!(link_settings(&report, 38_400), [family.clone(), ("baud", "38400".to_owned())]);
        assert_eq!(link_settings(&report, 500_000), [family]);
    }

    #[test]
    fn family_has_a_probe_exactly_if_its_features_say_so() {
        for family in Family::ALL {
            assert_eq!(
                identity_probe(family, None, 0).is_some(),
                features(family).has_identity_probe,
                "{family:?}"
            );
        }
    }
}
