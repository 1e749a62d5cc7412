//! Checks whether the scanner at a port has the configured settings, and is healthy. The checks of an LMS come first,
//! then those of a link of the hub, and last those of a rotating scanner. `probe` sends the requests.

use scanhub_config::Link;
use scanhub_drivers::line::{DeviceInfo, HealthStatus as ReportedHealth};
use scanhub_drivers::lms::identity_probe::Report;
use scanhub_drivers::lms::lms_model::LmsModel;
use scanhub_drivers::lms::status::{Fault, Severity, StatusByte};
use scanhub_drivers::lms::variant::Variant;
use scanhub_port::Holder;
use scanhub_schema::{State, Status};

use super::line::{LOSS_REMEDY, is_mostly_damaged};
use super::{Finding, Hub};
use crate::driver::{DetectedScanner, LINE_REMEDY};

/// Checks the LMS at `port` by its `report`.
pub(crate) fn check_report(port: &str, report: &Report, link: Option<&Link>) -> Vec<Finding> {
    let mut status =
        Status { mode: report.status().map_or(Status::MODE_UNKNOWN, |it| it.mode().0), ..Status::default() };
    status.set_port(port);
    let mut findings = vec![identity(report)];
    findings.extend(settings(port, report, link));
    findings.extend([power_on(port, report), health(report)]);
    findings.extend(marks(&status, ""));
    findings
}

/// Checks a link of `hub` by its status. `holders` have its port open.
pub(crate) fn check_hub_link(hub: &Hub, (name, status): (&str, &Status), holders: &[Holder]) -> Vec<Finding> {
    // If the line damages most bytes, the remedy is not `info`, because `info` shows no more about it than this check.
    let remedy =
        if is_mostly_damaged(status) { LOSS_REMEDY.to_owned() } else { hub.remedy(name, status, holders) };
    let marks = marks(status, "stop the hub first: ");
    std::iter::once(hub_link_finding(name, status, remedy)).chain(marks).collect()
}

/// Checks whether the measuring mode of an LMS has bits for reflectors. Returns `None` if the mode is unknown, or if a
/// scanner of another family has no configured threshold, because this needs no remedy.
fn marks(status: &Status, when: &str) -> Option<Finding> {
    const NAME: &str = "marks";
    let Some(mode) = status.missing_reflector_mode() else {
        let is_lms = status.family() == Some(scanhub_schema::Family::Lms);
        let why = if is_lms { "the measuring mode has reflector bits" } else { "marks.level is set" };
        return status.has_marks()?.then(|| Finding::ok(NAME, why));
    };
    let what = format!(
        "the measuring mode, {:02x}h, has no reflector bits: topic marks is unavailable",
        status.mode
    );
    let remedy = format!("{when}scanhub configure {} mode={mode:#04x}", status.port());
    Some(Finding::warning(NAME, what, remedy))
}

fn hub_link_finding(name: &str, status: &Status, remedy: String) -> Finding {
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
    match (status.state(), status.last_error()) {
        (Some(State::Streaming | State::Paused), "") if !status.is_replayed() => {
            Finding::ok(NAME, format!("{text}, {} Bd", status.baud))
        }
        (_, "") if status.is_replayed() => Finding::ok(NAME, text),
        // At its end, a recording is silent.
        (Some(State::Silent), error) if status.is_replayed() => Finding::ok(NAME, format!("{text}: {error}")),
        (Some(State::Streaming | State::Paused), error) => {
            Finding::warning(NAME, format!("{text}: {error}"), remedy)
        }
        (_, error) if status.is_replayed() => Finding::warning(NAME, format!("{text}: {error}"), remedy),
        // The link has just started, and a search reports its problem only after some seconds.
        (Some(State::Absent) | None, "") => Finding::failed(NAME, text, remedy),
        (_, "") => Finding::warning(NAME, format!("{text}; the hub has not found a problem yet"), remedy),
        (_, error) => Finding::failed(NAME, format!("{text}: {error}"), remedy),
    }
}

/// Reports type and rate.
fn identity(report: &Report) -> Finding {
    const NAME: &str = "sensor";
    let kind = report.kind().map(|kind| String::from_utf8_lossy(kind).into_owned());
    let rate = report.baud.map_or(0, |baud| baud.rate());
    let text =
        format!("{} at {rate} Bd", kind.as_deref().unwrap_or("a sensor that does not report its type"));
    Finding::ok(NAME, text)
}

/// Checks whether type and unit are those of the configuration. Returns a finding for each difference.
fn settings(port: &str, report: &Report, link: Option<&Link>) -> Vec<Finding> {
    const NAME: &str = "settings";
    let Some(status) = report.status() else {
        return vec![Finding::warning(NAME, "it does not report its settings", "power it off and on again")];
    };
    let text = format!(
        "{}, {}, measuring mode {:02x}h",
        status.variant().map_or("unknown view".into(), describe_variant),
        status.unit().map_or("unknown unit".into(), |unit| format!("unit {} mm", unit.mm())),
        status.mode().0
    );
    let mut differences = Vec::new();
    let family = report.kind().and_then(LmsModel::of_type);
    let scanner = link.map(|link| &link.scanner);
    if let Some((expected, is)) = scanner.and_then(|scanner| scanner.settings.expected_type).zip(family)
        && expected != is.name()
    {
        differences.push(Finding::warning(
            NAME,
            format!("the configuration says type {expected}, it is a {}", is.name()),
            "correct the type in the configuration, or plug in the other sensor",
        ));
    }
    if let Some((expected, is)) = scanner.and_then(|scanner| scanner.settings.unit_mm).zip(status.unit())
        && expected != is.mm()
    {
        differences.push(Finding::warning(
            NAME,
            format!("{text}; the configuration says unit {expected} mm"),
            format!(
                "scanhub configure {port} unit={}, or correct the configuration",
                if expected == 1 { "mm" } else { "cm" }
            ),
        ));
    }
    if differences.is_empty() {
        return vec![Finding::ok(NAME, text)];
    }
    differences
}

/// Checks whether an earlier owner has changed the rate after power-on, or left the scanner in installation mode.
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
    if status.is_some_and(|status| status.operating_mode() == INSTALLATION_MODE) {
        whats.push("an earlier owner left it in installation mode, in which its field outputs are blocked");
        remedies.push("scanhub run leaves it by itself; or power it off and on again".to_owned());
    }
    if whats.is_empty() {
        return Finding::ok(NAME, "starts at 9600 Bd");
    }
    Finding::warning(NAME, whats.join("; "), remedies.join("; "))
}

/// Checks the state that the scanner reports: a defect, the window, the laser, and its errors.
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
    let reported = report.status_byte.and_then(|byte| StatusByte(byte).severity());
    if reported >= Some(Severity::Warning) && reported > worst {
        complaints.insert(0, format!("its telegrams say {}", reported.map_or("", Severity::name)));
        worst = reported;
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
    let window_remedy = "clean its window, check what is in front of it";
    if worst >= Some(Severity::Error) {
        let remedy = format!("{window_remedy}, power it off and on again; if it stays, a repair{past}");
        return Finding::failed(NAME, complaints.join("; "), remedy);
    }
    Finding::warning(NAME, complaints.join("; "), format!("{window_remedy}{past}"))
}

fn describe_variant(variant: Variant) -> String {
    let Variant { angle_deg, resolution_cdeg } = variant;
    format!("{angle_deg} degrees at {}", f64::from(resolution_cdeg) / 100.0)
}

/// Operating mode in which the EEPROM can be written.
const INSTALLATION_MODE: u8 = 0x00;

/// Checks a rotating `scanner` that was detected.
pub(crate) fn check_rotating(scanner: &DetectedScanner, link: Option<&Link>) -> Vec<Finding> {
    let text = format!("{scanner}, family {}", scanner.family.name());
    let mut findings = vec![match &scanner.introduction {
        Some(introduction) => Finding::ok("sensor", format!("{text}, {}", introduction.identity)),
        None => Finding::ok("sensor", text),
    }];
    findings.push(loss(scanner));
    let is_reported = scanner.introduction.is_some();
    if scanner.is_unreliable() && !is_reported {
        let why = "not checked: the line damages most bytes";
        findings.extend(["settings", "health"].map(|name| Finding::skipped(name, why)));
        return findings;
    }
    findings.extend([
        model(scanner, link),
        scanner
            .introduction
            .as_ref()
            .map_or_else(|| rotation(scanner), |introduction| reported_health(introduction, scanner)),
    ]);
    findings
}

/// Checks the health that the scanner reports, and whether it measures.
fn reported_health(introduction: &DeviceInfo, scanner: &DetectedScanner) -> Finding {
    const NAME: &str = "health";
    let remedy = "see whether its head rotates freely; power it off and on again; if it stays so, a repair";
    match introduction.condition {
        ReportedHealth::Good | ReportedHealth::Warning | ReportedHealth::Unknown if scanner.packets == 0 => {
            let problem = scanner.problem.as_deref().unwrap_or("it does not measure");
            Finding::failed(NAME, problem, remedy)
        }
        ReportedHealth::Unknown => Finding::warning(NAME, "it does not report its health", remedy),
        ReportedHealth::Good => Finding::ok(NAME, introduction.health.clone()),
        ReportedHealth::Warning => Finding::warning(NAME, introduction.health.clone(), remedy),
        ReportedHealth::Error => Finding::failed(NAME, introduction.health.clone(), remedy),
    }
}

/// Checks whether the scanner is the configured model, and whether topics have room for its points.
fn model(scanner: &DetectedScanner, link: Option<&Link>) -> Finding {
    const NAME: &str = "settings";
    let text = match (&scanner.introduction, scanner.model) {
        (None, _) => {
            format!(
                "{:.0} points per second, {:.0} per revolution",
                scanner.points_per_second,
                scanner.points()
            )
        }
        (Some(_), Some(model)) => format!("up to {} points per revolution", model.beams),
        (Some(_), None) => "a model that this version does not have".to_owned(),
    };
    let Some((model, link)) = scanner.model.zip(link) else { return Finding::ok(NAME, text) };
    let (set, name) = (link.scanner.model(), &link.name);
    let is_named = link.scanner.settings.model.is_some();
    if is_named && (set.baud, set.beams) != (model.baud, model.beams) {
        return Finding::warning(
            NAME,
            format!(
                "model {} is configured, but the scanner is a {} or compatible with it",
                set.name, model.name
            ),
            format!("--set link.{name}.model={}, or plug in the other scanner", model.name),
        );
    }
    if link.scanner.is_auto() && link.max_beams() < model.beams {
        return Finding::warning(
            NAME,
            format!("{text}, and there is room for {} beams", link.max_beams()),
            format!("--set link.{name}.model={}, or link.{name}.beams", model.name),
        );
    }
    Finding::ok(NAME, text)
}

/// Checks whether the head of a scanner that reports no health rotates.
fn rotation(scanner: &DetectedScanner) -> Finding {
    const NAME: &str = "health";
    if scanner.revolutions_per_second > 0.0 {
        return Finding::ok(NAME, format!("{:.1} revolutions per second", scanner.revolutions_per_second));
    }
    let what = scanner.problem.as_deref().unwrap_or("packets arrive, but no revolution was complete");
    let (what, _) = what.split_once(": ").unwrap_or((what, ""));
    Finding::failed(
        NAME,
        what,
        "see whether its head rotates freely, and whether it gets 5 V; power it off and on again",
    )
}

/// Checks how many packets are damaged or lost.
fn loss(scanner: &DetectedScanner) -> Finding {
    const NAME: &str = "line-loss";
    let (damaged, lost) = (100.0 * scanner.damaged(), scanner.stats.lost);
    if scanner.packets == 0 {
        return Finding::skipped(NAME, "it does not measure");
    }
    let packets = match lost {
        // Damaged packets are lost, too, but too few undamaged packets arrive to count the lost ones.
        0 if scanner.is_unreliable() => "the number of lost packets is unknown".to_owned(),
        lost => format!("{lost} of {} packets lost", scanner.stats.due),
    };
    let text = format!("{damaged:.1} % of the bytes damaged, {packets}");
    if scanner.is_unreliable() {
        return Finding::failed(NAME, text, LINE_REMEDY);
    }
    if lost * PACKETS_PER_LOSS > scanner.stats.due || scanner.line_problem().is_some() {
        return Finding::warning(NAME, text, LINE_REMEDY);
    }
    Finding::ok(NAME, text)
}

/// A line that loses more than one packet out of this number of packets needs a remedy.
const PACKETS_PER_LOSS: u64 = 100;

#[cfg(test)]
mod tests {
    use scanhub_drivers::line::{Action, Protocol as _, SessionStats};
    use scanhub_drivers::lms::status::SimulatedStatus;
    use scanhub_drivers::lms::telegram::{Telegram, Writer};
    use scanhub_drivers::lms::variant::{Baud, Mode, Unit};
    use scanhub_drivers::lms::{IdentityProbe, configuration};
    use scanhub_drivers::{Settings, features};

    use super::*;
    use crate::doctor::State as Verdict;

    /// Returns the report of a probe to a scanner with this status report, status byte and errors.
    fn report(status: [u8; 152], condition: u8, errors: &[u8]) -> Report {
        let mut probe = IdentityProbe::new(Baud::B38400, 0);
        let (mut now, mut request, mut reply) = (0, Vec::new(), Vec::new());
        loop {
            match probe.poll_action() {
                Action::Transmit { bytes, not_before } => {
                    now = not_before.max(now);
                    request.extend(bytes);
                    probe.handle_transmitted(now);
                    if let Some(received) = Telegram::check(&request) {
                        let data: Vec<u8> = match received.command() {
                            0x31 => status.to_vec(),
                            0x32 => errors.to_vec(),
                            0x3A => b"LMS200;301063;V02.30 ".to_vec(),
                            _ => configuration::factory_configuration(Mode(1), Unit::Mm).to_vec(),
                        };
                        let telegram =
                            Writer::new(0x80, received.command() | 0x80).slice(&data).byte(condition);
                        reply = telegram.finish().bytes().to_vec();
                        request.clear();
                    }
                }
                Action::Wait { until } => {
                    if probe.is_done() {
                        return probe.report().clone();
                    }
                    now = until;
                    let bytes = std::mem::take(&mut reply);
                    probe.read_buffer()[..bytes.len()].copy_from_slice(&bytes);
                    probe.commit(now, bytes.len());
                    if bytes.is_empty() {
                        probe.handle_timeout(now);
                    }
                }
                output => panic!("{output:?}"),
            }
        }
    }

    fn healthy() -> [u8; 152] {
        with_mode(1)
    }

    fn with_mode(mode: u8) -> [u8; 152] {
        let health = SimulatedStatus {
            software: *b"V02.30 ",
            operating_mode: 0x25,
            mode: Mode(mode),
            variant: Variant::HALF,
            unit: Unit::Mm,
            baud: Baud::B38400,
        };
        health.report()
    }

    /// Returns the state and the text of a check on a scanner whose status has `byte` at index `at`.
    fn verdict(name: &str, at: usize, byte: u8, condition: u8, errors: &[u8]) -> (Verdict, String) {
        let mut status = healthy();
        status[at] = byte;
        let findings = check_report("/dev/ttyUSB0", &report(status, condition, errors), None);
        let found = findings.iter().find(|finding| finding.name == name).expect("it is checked");
        (found.state, found.to_string())
    }

    #[test]
    fn reports_problems_of_scanner() {
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
        // A channel of the window reported 100 when the window was clean, and the first channel reports 20.
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
    fn reports_settings_of_earlier_owner() {
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
    fn reports_mode_without_reflector_bits() {
        let found = |mode: u8| {
            check_report("/dev/ttyUSB0", &report(with_mode(mode), 0x10, &[]), None)
                .pop()
                .expect("it is checked")
        };
        assert_eq!((found(1).name, found(1).state), ("marks", Verdict::Ok));
        assert_eq!(
            (found(0).state, found(0).remedy.as_str()),
            (Verdict::Warning, "scanhub configure /dev/ttyUSB0 mode=0x01")
        );
    }

    #[test]
    fn reports_settings_that_differ_from_configuration() {
        let link = Link {
            name: "front".into(),
            port: scanhub_port::PortSpec::Tty("/dev/ttyUSB0".into()),
            scanner: scanhub_config::Scanner {
                family: Some(scanhub_schema::Family::Lms),
                settings: Settings {
                    expected_type: Some("lms291"),
                    unit_mm: Some(10),
                    ..Settings::default()
                },
                named_by: vec!["family"],
            },
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
    fn passes_on_status_of_hub() {
        let mut status = Status { state: State::Streaming as u8, baud: 500_000, ..Status::default() };
        let hub = Hub::without_links(7);
        let findings = |status: &Status| check_hub_link(&hub, ("front", status), &[]);
        assert_eq!(findings(&status).iter().map(|finding| finding.state).collect::<Vec<_>>(), [Verdict::Ok]);
        status.mode = 0;
        status.set_port("/dev/ttyUSB0");
        let [_, marks] = &findings(&status)[..] else { panic!("no finding about marks") };
        assert_eq!(marks.state, Verdict::Warning);
        assert_eq!(marks.remedy, "stop the hub first: scanhub configure /dev/ttyUSB0 mode=0x01");
        status.set_last_error("the window is dirty");
        let dirty = &findings(&status)[0];
        assert!(dirty.state == Verdict::Warning && dirty.finding.contains("window"), "{dirty}");
        assert_eq!(dirty.remedy, "scanhub info front");
        status.state = State::Silent as u8;
        let silent = &findings(&status)[0];
        assert_eq!(silent.state, Verdict::Failed);
        let remedy =
            "scanhub info front; or stop the hub (kill 7), then search the port: scanhub probe /dev/ttyUSB0";
        assert_eq!(silent.remedy, remedy);
        status.set_last_error("");
        assert_eq!(findings(&status)[0].state, Verdict::Warning, "it has just begun");
        // A recording is silent at its end.
        status.set_port("file:/tmp/walk.mcap");
        status.set_last_error("the recording is at its end");
        assert_eq!(findings(&status)[0].state, Verdict::Ok);
    }

    /// Returns the family that streams without a request.
    fn streaming() -> scanhub_schema::Family {
        let is_streaming = |family: &scanhub_schema::Family| features(*family).streams_unrequested;
        scanhub_schema::Family::ALL.into_iter().find(is_streaming).expect("there is one")
    }

    fn detected() -> DetectedScanner {
        let family = streaming();
        DetectedScanner {
            family,
            model: Some(features(family).models[1]),
            model_text: Some(features(family).models[1].name.to_owned()),
            rate: 230_400,
            stats: SessionStats { in_telegrams: 9_400, due: 200, ..SessionStats::default() },
            introduction: None,
            packets: 200,
            points_per_second: 4_500.0,
            revolutions_per_second: 10.0,
            problem: None,
        }
    }

    fn link(set: &[&str]) -> Link {
        let sources = scanhub_config::Sources {
            files: Vec::new(),
            set: set.iter().map(|flag| format!("link.side.{flag}")).collect(),
            links: vec!["side=/dev/ttyUSB0".to_owned()],
        };
        scanhub_config::Config::load(&sources).expect("it is valid").links.remove(0)
    }

    #[test]
    fn checks_rotating_scanner() {
        let verdicts = |detected: &DetectedScanner| {
            let findings = check_rotating(detected, None);
            findings.iter().map(|finding| (finding.name, finding.state)).collect::<Vec<_>>()
        };
        let names = ["sensor", "line-loss", "settings", "health"];
        assert_eq!(verdicts(&detected()), names.map(|name| (name, Verdict::Ok)));
        let still = DetectedScanner { revolutions_per_second: 0.0, ..detected() };
        assert_eq!(verdicts(&still)[3], ("health", Verdict::Failed));
        let lossy = DetectedScanner { stats: SessionStats { lost: 3, ..detected().stats }, ..detected() };
        assert_eq!(verdicts(&lossy)[1], ("line-loss", Verdict::Warning));
        let damaged =
            DetectedScanner { stats: SessionStats { damaged: 100, ..detected().stats }, ..detected() };
        assert_eq!(verdicts(&damaged)[1], ("line-loss", Verdict::Warning));
        let text = check_rotating(&damaged, None)[1].to_string();
        assert!(text.contains(", 0 of "), "{text}");
        // If most bytes are damaged, a head that seems to stand still may rotate.
        let account = SessionStats { damaged: 40_000, ..detected().stats };
        let unreliable = [
            ("sensor", Verdict::Ok),
            ("line-loss", Verdict::Failed),
            ("settings", Verdict::Skipped),
            ("health", Verdict::Skipped),
        ];
        let most = DetectedScanner { stats: account, ..still };
        assert_eq!(verdicts(&most), unreliable);
        let text = check_rotating(&most, None)[1].to_string();
        assert!(text.contains("the number of lost packets is unknown"), "{text}");
    }

    #[test]
    fn checks_reported_health() {
        let verdicts = |condition| {
            let verdicts = DeviceInfo { identity: "firmware 1.29".into(), health: "so".into(), condition };
            let findings =
                check_rotating(&DetectedScanner { introduction: Some(verdicts), ..detected() }, None);
            findings.iter().map(|finding| (finding.name, finding.state)).next_back()
        };
        for (condition, state) in [
            (ReportedHealth::Good, Verdict::Ok),
            (ReportedHealth::Warning, Verdict::Warning),
            (ReportedHealth::Unknown, Verdict::Warning),
            (ReportedHealth::Error, Verdict::Failed),
        ] {
            assert_eq!(verdicts(condition), Some(("health", state)));
        }
    }

    #[test]
    fn reports_model_that_differs_from_configuration() {
        let family = format!("family={}", detected().family.name());
        let judged = |detected: &DetectedScanner, set: &[&str]| {
            model(detected, Some(&link(&[&[family.as_str()], set].concat())))
        };
        let models = features(streaming()).models;
        // A model with the same protocol counts as the configured model.
        let (like, other) = (format!("model={}", models[0].name), format!("model={}", models[3].name));
        assert_eq!(judged(&detected(), &[&like]).state, Verdict::Ok);
        let wrong = judged(&detected(), &[&other]);
        assert!(wrong.state == Verdict::Warning && wrong.finding.contains(models[3].name), "{wrong}");
        assert!(wrong.remedy.contains("link.side.model="), "{wrong}");
        let large = DetectedScanner { model: Some(models[3]), ..detected() };
        assert_eq!(judged(&large, &[&other]).state, Verdict::Ok);
        let room = judged(&large, &[]);
        assert!(room.state == Verdict::Warning && room.finding.contains("room for 720"), "{room}");
    }
}
