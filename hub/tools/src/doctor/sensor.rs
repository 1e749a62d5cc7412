//! The sensor at the other end: whether it answers, is set as configured, and is healthy. Judges its answers; refuses to
//! ask.

use config::Link;
use scanhub_drivers::lms::condition::{Condition, Severity};
use scanhub_drivers::lms::errors::Fault;
use scanhub_drivers::lms::family::Family;
use scanhub_drivers::lms::inquiry::Report;
use scanhub_drivers::lms::variant::{Unit, Variant};
use schema::{State, Status};

use super::counts::{LOSS_REMEDY, is_mostly_damaged};
use super::finding::Finding;

/// What follows from what the sensor at `port` said of itself.
pub(crate) fn examine(port: &str, report: &Report, link: Option<&Link>) -> Vec<Finding> {
    let mut told =
        Status { mode: report.status().map_or(Status::MODE_UNKNOWN, |it| it.mode().0), ..Status::default() };
    told.set_port(port);
    let mut findings = vec![answer(report)];
    findings.extend(settings(port, report, link));
    findings.extend([power_on(port, report), health(report)]);
    findings.extend(marks(&told, ""));
    findings
}

/// The port is the hub's: what it says of its link.
pub(crate) fn as_the_hub_says(link: Option<(&str, &Status)>, why_unknown: &str) -> Vec<Finding> {
    match link {
        None => vec![Finding::skipped("sensor", why_unknown)],
        Some((name, status)) => {
            let marks = marks(status, "stop the hub first: ");
            std::iter::once(link_of_the_hub(name, status)).chain(marks).collect()
        }
    }
}

/// Whether marks can be found; nothing as long as the mode is not known. Who needs none may leave it so.
fn marks(status: &Status, when: &str) -> Option<Finding> {
    const NAME: &str = "marks";
    let Some(remedy) = status.reflector_remedy() else {
        return status
            .has_reflector_bits()?
            .then(|| Finding::ok(NAME, "the measuring mode has reflector bits"));
    };
    let what = format!(
        "the measuring mode, {:02x}h, has no reflector bits: topic marks is unavailable",
        status.mode
    );
    Some(Finding::warning(NAME, what, format!("{when}{remedy}")))
}

fn link_of_the_hub(name: &str, status: &Status) -> Finding {
    const NAME: &str = "sensor";
    let text = format!(
        "link {name} of the hub: {}, family {}, {}",
        status.state().map_or("unknown", State::name),
        status.family().map_or("unknown", |family| family.name()),
        match status.sensor_type() {
            "" => "type not known",
            kind => kind,
        }
    );
    // `info` shows no more of a damaged line than this check.
    let remedy =
        if is_mostly_damaged(status) { LOSS_REMEDY.to_owned() } else { format!("scanhub info {name}") };
    match (status.state(), status.last_error()) {
        (Some(State::Streaming | State::Paused), "") => {
            Finding::ok(NAME, format!("{text}, {} Bd", status.baud))
        }
        (Some(State::Streaming | State::Paused), error) => {
            Finding::warning(NAME, format!("{text}: {error}"), remedy)
        }
        (_, error) => Finding::failed(NAME, format!("{text}: {error}"), remedy),
    }
}

/// Who it is.
fn answer(report: &Report) -> Finding {
    const NAME: &str = "sensor";
    let kind = report.kind().map(|kind| String::from_utf8_lossy(kind).into_owned());
    let rate = report.baud.map_or(0, |baud| baud.rate());
    let text =
        format!("{} at {rate} Bd", kind.as_deref().unwrap_or("a sensor that does not report its type"));
    Finding::ok(NAME, text)
}

/// Whether type and unit are those of the configuration: a finding of each that is not.
fn settings(port: &str, report: &Report, link: Option<&Link>) -> Vec<Finding> {
    const NAME: &str = "settings";
    let Some(status) = report.status() else {
        return vec![Finding::warning(NAME, "it does not report its settings", "power it off and on again")];
    };
    let text = format!(
        "{}, {}, measuring mode {:02x}h",
        status.variant().map_or("unknown view".into(), in_words),
        status.unit().map_or("unknown unit".into(), |unit| format!("unit {} mm", unit.mm())),
        status.mode().0
    );
    let mut wrong = Vec::new();
    let family = report.kind().and_then(Family::of_type);
    if let Some((expected, is)) = link.and_then(|link| link.family).zip(family)
        && expected != is
    {
        wrong.push(Finding::warning(
            NAME,
            format!("the configuration says type {}, it is a {}", expected.name(), is.name()),
            "correct the type in the configuration, or plug in the other sensor",
        ));
    }
    if let Some((expected, is)) = link.and_then(|link| link.unit).zip(status.unit())
        && expected != is
    {
        wrong.push(Finding::warning(
            NAME,
            format!("{text}; the configuration says unit {} mm", expected.mm()),
            format!("scanhub configure {port} unit={}, or correct the configuration", word(expected)),
        ));
    }
    if wrong.is_empty() {
        return vec![Finding::ok(NAME, text)];
    }
    wrong
}

/// Whether a former owner has changed the rate at which it comes up, or left it in installation mode.
fn power_on(port: &str, report: &Report) -> Finding {
    const NAME: &str = "power-on";
    let status = report.status();
    let (mut whats, mut remedies) = (Vec::new(), Vec::new());
    if status.is_some_and(|status| status.has_permanent_baud()) {
        whats.push("it starts at another rate than 9600 Bd, which an earlier owner has set");
        remedies.push(format!(
            "the hub finds it anyway, other programs may not: scanhub configure {port} power_on_baud=9600"
        ));
    }
    if status.is_some_and(|status| status.operating_mode() == INSTALLATION) {
        whats.push("an earlier owner left it in installation mode, in which its field outputs are blocked");
        remedies.push("scanhub run leaves it by itself; or power it off and on again".to_owned());
    }
    if whats.is_empty() {
        return Finding::ok(NAME, "starts at 9600 Bd");
    }
    Finding::warning(NAME, whats.join("; "), remedies.join("; "))
}

/// What it complains of: itself, its window, its errors.
fn health(report: &Report) -> Finding {
    const NAME: &str = "health";
    let faults: Vec<Fault> = report.errors().map(|errors| errors.iter().collect()).unwrap_or_default();
    let is_current = |fault: &&Fault| !fault.is_past() && fault.severity() >= Some(Severity::Warning);
    let current: Vec<&Fault> = faults.iter().filter(is_current).collect();
    let mut complaints: Vec<String> = current.iter().map(ToString::to_string).collect();
    let mut worst = current.iter().filter_map(|fault| fault.severity()).max();
    let status = report.status();
    if status.is_some_and(|status| !status.is_laser_on()) {
        complaints.insert(0, "its laser is off".to_owned());
    }
    let told = report.status_byte.and_then(|byte| Condition(byte).severity());
    if told >= Some(Severity::Warning) && told > worst {
        complaints.insert(0, format!("its telegrams say {}", told.map_or("", Severity::name)));
        worst = told;
    }
    if report.is_polluted() == Some(true) {
        let percent = status.and_then(|status| status.window_percent());
        let percent = percent.map_or(String::new(), |percent| format!(", {percent} % clear"));
        complaints.insert(0, format!("its window is dirty{percent}"));
    }
    if status.is_some_and(|status| status.is_defective()) {
        complaints.insert(0, "it reports that it is defective".to_owned());
        return Finding::failed(NAME, complaints.join("; "), "it needs a repair: no setting changes that");
    }
    let past = match faults.iter().filter(|fault| fault.is_past()).count() {
        0 => String::new(),
        past => format!(", {past} in its memory: scanhub probe shows them"),
    };
    if complaints.is_empty() {
        return Finding::ok(NAME, format!("no complaint{past}"));
    }
    let look = "clean its window, check what is in front of it";
    if worst >= Some(Severity::Error) {
        let remedy = format!("{look}, power it off and on again; if it stays, a repair{past}");
        return Finding::failed(NAME, complaints.join("; "), remedy);
    }
    Finding::warning(NAME, complaints.join("; "), format!("{look}{past}"))
}

fn in_words(variant: Variant) -> String {
    let Variant { angle_deg, resolution_cdeg } = variant;
    format!("{angle_deg} degrees at {}", f64::from(resolution_cdeg) / 100.0)
}

fn word(unit: Unit) -> &'static str {
    match unit {
        Unit::Cm => "cm",
        Unit::Mm => "mm",
        Unit::Dm => "dm",
    }
}

/// The operating mode in which the EEPROM can be written.
const INSTALLATION: u8 = 0x00;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::finding::State as Verdict;
    use scanhub_drivers::lms::exchange::{Conversation, Output};
    use scanhub_drivers::lms::status_report::Health;
    use scanhub_drivers::lms::telegram::{Telegram, Writer};
    use scanhub_drivers::lms::variant::{Baud, Mode};
    use scanhub_drivers::lms::{Inquiry, configuration};

    /// What an inquiry makes of a sensor with this status report, status byte and errors.
    fn report(status: [u8; 152], condition: u8, errors: &[u8]) -> Report {
        let mut inquiry = Inquiry::new(Baud::B38400, 0);
        let (mut now, mut request, mut reply) = (0, Vec::new(), Vec::new());
        loop {
            match inquiry.poll_output() {
                Output::Done => return inquiry.report().clone(),
                Output::SetBaud(baud) => panic!("{baud:?}"),
                Output::Transmit { byte, not_before } => {
                    now = not_before.max(now);
                    request.push(byte);
                    inquiry.transmitted(now);
                    if let Some(asked) = Telegram::check(&request) {
                        let data: Vec<u8> = match asked.command() {
                            0x31 => status.to_vec(),
                            0x32 => errors.to_vec(),
                            0x3A => b"LMS200;301063;V02.30 ".to_vec(),
                            _ => configuration::factory(Mode(1), Unit::Mm).to_vec(),
                        };
                        let told = Writer::new(0x80, asked.command() | 0x80).slice(&data).byte(condition);
                        reply = told.finish().bytes().to_vec();
                        request.clear();
                    }
                }
                Output::Wait { until } => {
                    now = until;
                    let told = std::mem::take(&mut reply);
                    inquiry.spare()[..told.len()].copy_from_slice(&told);
                    inquiry.commit(now, told.len());
                    if told.is_empty() {
                        inquiry.handle_timeout(now);
                    }
                }
            }
        }
    }

    fn healthy() -> [u8; 152] {
        with_mode(1)
    }

    fn with_mode(mode: u8) -> [u8; 152] {
        let health = Health {
            software: *b"V02.30 ",
            operating_mode: 0x25,
            mode: Mode(mode),
            variant: Variant::HALF,
            unit: Unit::Mm,
            baud: Baud::B38400,
        };
        health.report()
    }

    /// Verdict and words of a check on a sensor of which byte `at` of the status is `byte`.
    fn verdict(name: &str, at: usize, byte: u8, condition: u8, errors: &[u8]) -> (Verdict, String) {
        let mut status = healthy();
        status[at] = byte;
        let findings = examine("/dev/ttyUSB0", &report(status, condition, errors), None);
        let found = findings.iter().find(|finding| finding.name == name).expect("it is checked");
        (found.state, found.to_string())
    }

    #[test]
    fn what_a_sensor_complains_of_is_told() {
        let (state, text) = verdict("health", 8, 0, 0x10, &[]);
        assert_eq!(state, Verdict::Ok, "{text}");
        let (state, text) = verdict("health", 8, 0, 0x11, &[0x84, 22, 1, 49]);
        assert!(state == Verdict::Ok && text.contains("1 in its memory"), "{text}");
        let (state, text) = verdict("health", 8, 0, 0x92, &[2, 18]);
        assert!(state == Verdict::Warning && text.contains("window is dirty; warning 18"), "{text}");
        let (state, text) = verdict("health", 8, 0, 0x13, &[3, 18]);
        assert!(state == Verdict::Failed && text.contains("error 18"), "{text}");
        let (state, text) = verdict("health", 8, 0, 0x13, &[0x83, 18]);
        assert!(state == Verdict::Failed && text.contains("telegrams say error"), "{text}");
        let (state, text) = verdict("health", 8, 0, 0x10, &[0x83, 18]);
        assert!(state == Verdict::Ok && text.contains("1 in its memory"), "{text}");
        // A clean channel gave 100, the first gives 20.
        let mut dim = healthy();
        dim[42] = 100;
        dim[18] = 20;
        let found = health(&report(dim, 0x10, &[]));
        assert_eq!(found.state, Verdict::Warning, "{found}");
        assert!(found.finding.contains("window is dirty, 20 % clear"), "{found}");
        let (state, text) = verdict("health", 122, 0, 0x10, &[]);
        assert!(state == Verdict::Warning && text.contains("laser is off"), "{text}");
        let (state, text) = verdict("health", 8, 1, 0x14, &[4, 29]);
        assert!(state == Verdict::Failed && text.contains("defective; fatal 29: motor"), "{text}");
    }

    #[test]
    fn what_a_former_owner_left_is_told() {
        assert_eq!(verdict("power-on", 118, 0, 0x10, &[]).0, Verdict::Ok);
        let (state, text) = verdict("power-on", 118, 1, 0x10, &[]);
        assert!(
            state == Verdict::Warning && text.contains("configure /dev/ttyUSB0 power_on_baud=9600"),
            "{text}"
        );
        let (state, text) = verdict("power-on", 7, 0x00, 0x10, &[]);
        assert!(state == Verdict::Warning && text.contains("installation mode"), "{text}");
    }

    #[test]
    fn a_mode_without_marks_is_told() {
        let found = |mode: u8| {
            examine("/dev/ttyUSB0", &report(with_mode(mode), 0x10, &[]), None).pop().expect("it is checked")
        };
        assert_eq!((found(1).name, found(1).state), ("marks", Verdict::Ok));
        assert_eq!(
            (found(0).state, found(0).remedy.as_str()),
            (Verdict::Warning, "scanhub configure /dev/ttyUSB0 mode=0x01")
        );
    }

    #[test]
    fn what_the_configuration_says_otherwise_is_told() {
        let link = Link {
            name: "front".into(),
            port: port::Source::Tty("/dev/ttyUSB0".into()),
            scanner: config::Scanner::Lms,
            family: Some(Family::Lms291),
            variant: Variant::HALF,
            unit: Some(Unit::Cm),
            mode: None,
            baud: Baud::B500000,
            processing: Default::default(),
        };
        let judged = |link| settings("/dev/ttyUSB0", &report(healthy(), 0x10, &[]), link);
        let [kind, unit] = &judged(Some(&link))[..] else { panic!("two are wrong") };
        assert!(kind.state == Verdict::Warning && unit.state == Verdict::Warning, "{kind} {unit}");
        assert!(kind.finding.contains("type lms291, it is a lms200"), "{kind}");
        assert!(unit.remedy.contains("configure /dev/ttyUSB0 unit=cm"), "{unit}");
        assert_eq!(judged(None).iter().map(|finding| finding.state).collect::<Vec<_>>(), [Verdict::Ok]);
    }

    #[test]
    fn what_the_hub_says_is_passed_on() {
        let mut status = Status { state: State::Streaming as u8, baud: 500_000, ..Status::default() };
        let told = |status: &Status| as_the_hub_says(Some(("front", status)), "");
        assert_eq!(told(&status).iter().map(|finding| finding.state).collect::<Vec<_>>(), [Verdict::Ok]);
        status.mode = 0;
        status.set_port("/dev/ttyUSB0");
        let [_, marks] = &told(&status)[..] else { panic!("of marks nothing") };
        assert_eq!(marks.state, Verdict::Warning);
        assert_eq!(marks.remedy, "stop the hub first: scanhub configure /dev/ttyUSB0 mode=0x01");
        status.set_last_error("the window is dirty");
        let dirty = &told(&status)[0];
        assert!(dirty.state == Verdict::Warning && dirty.finding.contains("window"), "{dirty}");
        status.state = State::Silent as u8;
        assert_eq!(told(&status)[0].state, Verdict::Failed);
        assert_eq!(as_the_hub_says(None, "it is unknown")[0].state, Verdict::Skipped);
    }
}
