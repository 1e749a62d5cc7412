//! Checks one port: its existence, holders, permissions and rates. Then checks the scanner at the other end of the
//! line, and counts the bytes that the line has damaged or lost.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use scanhub_port::{
    Holder, MAX_LATENCY_MS, Port, PortError, PortPermissions, PortSpec, PortlessAdapter, SerialPortInfo,
    UartCounters, all_holders, check_tty, latency_ms,
};
use scanhub_schema::{Counter, Failure, Kind, Status};

use super::hub::{Hub, other_reader};
use super::{Finding, PortTarget, sensor};
use crate::driver::UNRELIABLE_DAMAGE;
use crate::probe::{self, FoundScanner};

/// Checks a port and its scanner.
///
/// # Errors
///
/// Returns [`Kind::Interrupted`] if `stop` is set. Every other problem is a finding.
pub(crate) fn check_port(
    subject: &PortTarget,
    serial_ports: &[SerialPortInfo],
    hub: Option<&Hub>,
    stop: &AtomicBool,
    report: &mut dyn FnMut(Finding),
) -> Result<(), Failure> {
    // A hub that waits for the port reports the reason.
    let reported = hub.and_then(|hub| Some(sensor::check_hub_link(hub, hub.link(&subject.source)?, &[])));
    let path = match &subject.source {
        PortSpec::Tty(path) => path,
        PortSpec::File { path, .. } => {
            report(recording(path));
            reported.into_iter().flatten().for_each(report);
            return Ok(());
        }
        PortSpec::Tcp { .. } => return check_server(subject, hub, stop, report),
    };
    let candidate = candidate(path, serial_ports);
    if hub.is_some_and(|hub| hub.is_mute_link(&subject.source)) {
        report(Finding::skipped("port", "a link of the hub, which does not report its port"));
        return Ok(());
    }
    if let Err(error @ (PortError::NotTty | PortError::NoDevice | PortError::Other(_))) = check_tty(path) {
        report(access_failure(error.explain(&subject.source)));
        reported.into_iter().flatten().for_each(report);
        return Ok(());
    }
    report(port_finding(&subject.source, path, candidate));
    if !path.exists() {
        reported.into_iter().flatten().for_each(report);
        return Ok(());
    }
    let holders = all_holders(path);
    if !holders.is_empty() {
        // Opening the port would change its settings for the process that has it open.
        let own = hub.filter(|hub| holders.iter().any(|holder| holder.pid == hub.pid));
        let of_other_domain = if own.is_none() { Hub::at(&subject.source, &holders, &[]) } else { None };
        match own.or(of_other_domain.as_ref()) {
            Some(hub) => {
                report(latency(path, latency_ms(path)));
                report(holder_finding(&holders, hub.pid));
                let why = hub.unknown_reason();
                match hub.link(&subject.source) {
                    Some(link) => {
                        [hub_line_errors(link.1), line_loss(link.1)].into_iter().for_each(&mut *report);
                        sensor::check_hub_link(hub, link, &holders).into_iter().for_each(report);
                    }
                    None => {
                        ["line-errors", "sensor"]
                            .into_iter()
                            .for_each(|name| report(Finding::skipped(name, why)));
                    }
                }
            }
            None => {
                report(access_failure(PortError::Busy.explain(&subject.source)));
                let skipped = || vec![Finding::skipped("sensor", "its port is in use")];
                reported.unwrap_or_else(skipped).into_iter().for_each(report);
            }
        }
        return Ok(());
    }
    report(Finding::ok("holder", "no process has it open"));
    if !subject.is_named {
        // Opening the port would restart some devices.
        report(if candidate.is_none_or(|candidate| candidate.is_permitted) {
            Finding::ok("access", "may be opened")
        } else {
            access_failure(PortError::PermissionDenied.explain(&subject.source))
        });
        let name = subject.source.name();
        let why = format!("not opened, because the port was not named; scanhub doctor {name} checks it");
        let skipped = || vec![Finding::skipped("sensor", why)];
        reported.unwrap_or_else(skipped).into_iter().for_each(report);
        return Ok(());
    }
    let (port, first) = match probe::open(&subject.source, stop) {
        Ok(opened) => opened,
        Err(failure) => {
            report(access_failure(failure));
            return Ok(());
        }
    };
    report(Finding::ok("access", format!("can be opened, is a serial line{}", describe_permissions(path))));
    // Read the latency now: opening the port with the hub's settings makes most adapters return bytes at once.
    report(latency(path, latency_ms(path)));
    let answer = check_scanner(subject, &port, first, stop)?;
    // Without a reply, the bytes may have arrived at another rate, so their errors do not count.
    let reply_errors = if answer.is_ok() { port.line_errors() } else { 0 };
    let found = answer.as_ref().ok().and_then(|answer| answer.0);
    report(rate(subject, &port, first, found));
    scanner_findings(answer).into_iter().for_each(&mut *report);
    report(line_errors(port.uart_counters(), reply_errors));
    Ok(())
}

/// Checks a serial server and its scanner.
fn check_server(
    subject: &PortTarget,
    hub: Option<&Hub>,
    stop: &AtomicBool,
    report: &mut dyn FnMut(Finding),
) -> Result<(), Failure> {
    // Most servers accept one client at a time, so do not connect to the server of a link.
    if let Some((hub, link)) = hub.and_then(|hub| Some((hub, hub.link(&subject.source)?))) {
        report(Finding::ok("holder", format!("it is a link of the hub, process {}", hub.pid)));
        report(line_loss(link.1));
        sensor::check_hub_link(hub, link, &[]).into_iter().for_each(report);
        return Ok(());
    }
    match probe::open(&subject.source, stop) {
        Ok((port, first)) => {
            report(Finding::ok("access", "connected; its rate was set there, by hand"));
            scanner_findings(check_scanner(subject, &port, first, stop)?).into_iter().for_each(report);
            Ok(())
        }
        Err(failure) if failure.kind == Kind::Interrupted => Err(failure),
        Err(failure) => {
            report(access_failure(failure));
            Ok(())
        }
    }
}

/// Rate at which the scanner was found if it is a rotating scanner, and the findings about the scanner. If no scanner
/// replied, a finding with the reason.
type ScannerCheck = Result<(Option<u32>, Vec<Finding>), Finding>;

/// Checks the scanner at `port`, which is open at `first`, in bits per second.
fn check_scanner(
    subject: &PortTarget,
    port: &Port,
    first: u32,
    stop: &AtomicBool,
) -> Result<ScannerCheck, Failure> {
    let (source, link) = (&subject.source, subject.link.as_ref());
    match probe::find(port, first, source, link.and_then(scanhub_config::Link::family), stop, |_| {}) {
        Ok(FoundScanner::Reported(report)) => {
            Ok(Ok((None, sensor::check_report(&source.name(), &report, link))))
        }
        Ok(FoundScanner::Rotating(scanner)) => {
            Ok(Ok((Some(scanner.rate), sensor::check_rotating(&scanner, link))))
        }
        Err(failure) if failure.kind == Kind::Interrupted => Err(failure),
        Err(failure) => Ok(Err(Finding::failed("sensor", failure.message, failure.hint))),
    }
}

fn scanner_findings(check: ScannerCheck) -> Vec<Finding> {
    check.map_or_else(|finding| vec![finding], |(_, findings)| findings)
}

/// Checks the holders of a port that the hub has open. Another process takes bytes away from the hub. Only the service
/// manager may hold the port in addition to the hub, because it keeps the port for the next hub.
fn holder_finding(holders: &[Holder], hub: u32) -> Finding {
    const NAME: &str = "holder";
    let names: Vec<String> = holders.iter().map(ToString::to_string).collect();
    match other_reader(holders, hub) {
        None => Finding::ok(NAME, format!("the hub has it, {}", names.join(", "))),
        Some(other) => Finding::warning(
            NAME,
            format!("another process reads the port: {}", names.join(", ")),
            format!("end {other}: the hub loses every byte that it reads"),
        ),
    }
}

/// Returns group and mode of the port, as text.
fn describe_permissions(path: &Path) -> String {
    let rights = PortPermissions::of(path);
    rights.port.map_or(String::new(), |port| format!("; group {}, mode {:03o}", rights.group, port.mode))
}

fn recording(path: &Path) -> Finding {
    if path.is_file() {
        Finding::ok("port", "a recording")
    } else {
        Finding::failed("port", "no such file", "name an existing recording")
    }
}

/// Returns the port in the list of the machine's ports.
fn candidate<'a>(path: &Path, serial_ports: &'a [SerialPortInfo]) -> Option<&'a SerialPortInfo> {
    let device = path.canonicalize().ok()?;
    serial_ports.iter().find(|candidate| candidate.device == device)
}

/// Reports an adapter without a port, which is a failure if there is no other port to examine.
pub(crate) fn without_port(adapter: &PortlessAdapter, is_only: bool) -> Finding {
    let finding = if is_only { Finding::failed } else { Finding::warning };
    finding("ports", adapter.to_string(), adapter.remedy())
}

/// Checks whether the port exists, and whether its name does not change.
fn port_finding(source: &PortSpec, path: &Path, candidate: Option<&SerialPortInfo>) -> Finding {
    const NAME: &str = "port";
    if !path.exists() {
        return access_failure(PortError::Missing.explain(source));
    }
    let Some(SerialPortInfo { name, device, .. }) = candidate else {
        let device = path.canonicalize().unwrap_or_else(|_| path.to_owned());
        return Finding::ok(NAME, format!("{}, no hardware behind it", device.display()));
    };
    let text = candidate.map(describe).unwrap_or_default();
    if let Some((what, remedy)) = candidate.and_then(|candidate| candidate.caution(path)) {
        return Finding::warning(NAME, format!("{text}; {what}"), remedy);
    }
    if name != device && path == device {
        let remedy = format!("use the name {}, which does not change", name.display());
        return Finding::warning(
            NAME,
            format!("{text}; this name may belong to another adapter after a restart"),
            remedy,
        );
    }
    Finding::ok(NAME, text)
}

fn describe(candidate: &SerialPortInfo) -> String {
    let SerialPortInfo { device, driver, product, .. } = candidate;
    let mut text = device.display().to_string();
    for word in [product, driver].into_iter().flatten() {
        text = format!("{text}, {word}");
    }
    text
}

/// Returns the finding for a port that cannot be opened.
fn access_failure(failure: Failure) -> Finding {
    let name = match failure.kind {
        Kind::PortBusy => "holder",
        Kind::PortMissing => "port",
        Kind::PortRate => "rate",
        _ => "access",
    };
    Finding::failed(name, failure.message, failure.hint)
}

/// Checks whether the adapter of an open port delays bytes, for `ms` milliseconds.
fn latency(path: &Path, ms: Option<u8>) -> Finding {
    const NAME: &str = "latency";
    let Some(ms) = ms else { return Finding::skipped(NAME, "the driver has no latency timer") };
    if ms <= MAX_LATENCY_MS {
        return Finding::ok(NAME, format!("the adapter hands over bytes after {ms} ms"));
    }
    let device = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let name = device.file_name().unwrap_or_default().to_string_lossy();
    let remedy = format!(
        "echo 1 | sudo tee /sys/class/tty/{name}/device/latency_timer; permanently by udev: \
         SUBSYSTEM==\"usb-serial\", DRIVER==\"ftdi_sio\", ATTR{{latency_timer}}=\"1\""
    );
    Finding::warning(
        NAME,
        format!("the adapter collects bytes for {ms} ms: scans are late by as much"),
        remedy,
    )
}

/// Checks whether the port supports the rate of the stream: the rate at which a rotating scanner was `found`, or the
/// rate of the link.
fn rate(subject: &PortTarget, port: &Port, first: u32, found: Option<u32>) -> Finding {
    const NAME: &str = "rate";
    // If the family is unknown, the search for the scanner does without the rates that the port rejects.
    let link = subject.link.as_ref().filter(|link| link.family().is_some());
    let link_rate = link.map_or(probe::HIGHEST_RATE, scanhub_config::Link::rate);
    let required_rate = found.unwrap_or(link_rate);
    let outcome = port.set_baud(required_rate);
    let actual_rate = port.baud().filter(|&actual| actual != required_rate);
    // Restore the rate at which the port was opened, because the requests start at this rate.
    let _ = port.set_baud(first);
    match (outcome, link) {
        (Ok(()), _) => {
            let near = actual_rate
                .map_or(String::new(), |given| format!(": the driver sets {given} Bd, close enough"));
            let state = if found.is_some() { "in use" } else { "possible" };
            Finding::ok(NAME, format!("{required_rate} Bd is {state}{near}"))
        }
        (Err(error), Some(link)) if !link.scanner.features().models.is_empty() => Finding::failed(
            NAME,
            error.to_string(),
            "use an adapter that can set it: with a CP2102N, FT232R or newer",
        ),
        (Err(error), Some(link)) => Finding::failed(
            NAME,
            error.to_string(),
            format!(
                "use a rate that it can set: --set link.{}.baud=38400; or an adapter with an FT232R or newer",
                link.name
            ),
        ),
        (Err(error), None) => Finding::warning(
            NAME,
            error.to_string(),
            "at 38400 Bd (--set link.NAME.baud=38400) a sensor sends 5 scans a second instead of 37; an adapter with an \
             FT232R or newer can set 500 kBd",
        ),
    }
}

/// Name of the check of bytes that arrived damaged, or were lost before they could be read.
const LINE_ERRORS: &str = "line-errors";

/// Judges the counters that the driver of an open line has kept since it was loaded, if it counts errors.
/// `reply_errors` is the number of errors while a scanner replied at its rate. At a wrong rate every byte is an error,
/// and the search for a scanner tries wrong rates, so a few errors are ignored.
fn line_errors(counts: Option<UartCounters>, reply_errors: u64) -> Finding {
    let Some(counts) = counts else {
        return Finding::skipped(LINE_ERRORS, "the driver does not count errors");
    };
    let UartCounters { received, framing, overrun, parity, breaks, buffer } = counts;
    let text = format!(
        "framing {framing}, parity {parity}, breaks {breaks}, overruns {} in {received} bytes since its driver was loaded",
        overrun.wrapping_add(buffer)
    );
    let lost = overrun.wrapping_add(buffer);
    if reply_errors > MAX_ERRORS_NOW {
        return Finding::warning(
            LINE_ERRORS,
            format!("{reply_errors} errors while the sensor answered; {text}"),
            errors_remedy(false),
        );
    }
    if is_large(lost.into(), received.into()) {
        return Finding::warning(LINE_ERRORS, text, errors_remedy(true));
    }
    if is_large(counts.errors().into(), received.into()) {
        return Finding::warning(LINE_ERRORS, text, errors_remedy(false));
    }
    Finding::ok(LINE_ERRORS, text)
}

/// Judges the errors that the hub counted at one of its ports.
fn hub_line_errors(status: &Status) -> Finding {
    let (errors, bytes) = (status.counters[Counter::LineErrors], status.counters[Counter::BytesRead]);
    let text = format!("the hub counted {errors} in {bytes} bytes");
    if is_large(errors, bytes) {
        Finding::warning(LINE_ERRORS, text, errors_remedy(false))
    } else {
        Finding::ok(LINE_ERRORS, text)
    }
}

/// Judges the share of its stream that a line of the hub damages or loses.
fn line_loss(status: &Status) -> Finding {
    const NAME: &str = "line-loss";
    if let Some((discarded, read)) = status.discarded_and_read() {
        let text = format!(
            "no scans arrive, and {discarded} of {read} bytes since the hub's start were in no intact telegram"
        );
        return Finding::failed(NAME, text, LOSS_REMEDY);
    }
    let due = status.counters[Counter::DueOnLine];
    let all = match status.lost_on_line() {
        // Damaged scans are lost, too, but too few undamaged scans arrive to count the lost ones.
        Some(0) if is_mostly_damaged(status) => {
            format!("the number of lost {} is unknown", status.transmission_name())
        }
        Some(lost) => format!("{lost} of {due} {} lost since the hub's start", status.transmission_name()),
        None => format!("the number of lost {} is unknown", status.transmission_name()),
    };
    let text =
        format!("{:.2} % of the bytes damaged in the last 10 s, {all}", 100.0 * status.damaged_share());
    match status.line_loss() {
        Some(loss) if is_mostly_damaged(status) => {
            Finding::failed(NAME, format!("{loss}; {text}"), LOSS_REMEDY)
        }
        Some(loss) => Finding::warning(NAME, format!("{loss}; {text}"), LOSS_REMEDY),
        None => Finding::ok(NAME, text),
    }
}

/// Returns whether the line damages most bytes, which makes every conclusion from the undamaged bytes unreliable.
pub(crate) fn is_mostly_damaged(status: &Status) -> bool {
    status.damaged_share() > UNRELIABLE_DAMAGE
}

/// Returns whether `errors` in `bytes` bytes are more than the search for a scanner causes, and frequent enough to cost
/// scans.
fn is_large(errors: u64, bytes: u64) -> bool {
    errors > MAX_SEARCH_ERRORS && errors.saturating_mul(MIN_BYTES_PER_ERROR) > bytes
}

/// Returns the remedy for bytes that were lost in the machine, or damaged on the line.
fn errors_remedy(is_lost: bool) -> &'static str {
    if is_lost {
        "the machine did not fetch them in time: another USB socket, without a hub in between; a UART with a FIFO"
    } else {
        "the cable: ground, twisted pairs, 120 ohm across the receiving pair, away from motors; docs/wiring.md"
    }
}

/// Remedy for a line that loses bytes.
pub(crate) const LOSS_REMEDY: &str = "the cable and its ground; the adapter: one with an FT232R or newer, in a socket of the \
     machine; of a UART its FIFO (setserial -g); 120 ohm of termination at the receiving end; docs/wiring.md";
/// Maximum number of errors that are ignored while a scanner replies: a byte that was cut when the rate changed, and
/// one more.
const MAX_ERRORS_NOW: u64 = 2;
/// Maximum number of errors that are ignored, because the search for the rates of scanners causes about as many.
const MAX_SEARCH_ERRORS: u64 = 1000;
/// Minimum number of bytes per error on a good line. One error in 7,000 bytes damages one of ten telegrams.
const MIN_BYTES_PER_ERROR: u64 = 7000;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::State;

    #[test]
    fn warns_of_slow_adapter() {
        let of = |ms| latency(Path::new("/dev/ttyUSB0"), ms);
        assert_eq!([of(None).state, of(Some(1)).state], [State::Skipped, State::Ok]);
        assert_eq!(of(Some(MAX_LATENCY_MS)).state, State::Ok);
        let slow = of(Some(16));
        assert_eq!(slow.state, State::Warning);
        assert!(slow.remedy.contains("/sys/class/tty/ttyUSB0/device/latency_timer"), "{slow}");
    }

    #[test]
    fn warns_of_port_name_that_may_change() {
        // Devices that exist on every machine stand for the names of ports.
        let [device, by_path, shared] = ["/dev/null", "/dev/zero", "/dev/full"].map(Path::new);
        let twin = SerialPortInfo {
            name: by_path.to_owned(),
            device: device.to_owned(),
            shared_name: Some(shared.to_owned()),
            driver: Some("cp210x".to_owned()),
            product: None,
            holder: None,
            is_permitted: true,
        };
        let of = |path: &Path, port: &SerialPortInfo| {
            port_finding(&PortSpec::Tty(path.to_owned()), path, Some(port))
        };
        let found = of(shared, &twin);
        assert!(found.state == State::Warning && found.finding.contains("same serial number"), "{found}");
        assert!(found.remedy.contains("/dev/zero"), "{found}");
        assert_eq!(of(by_path, &twin).state, State::Ok);
        let numbered = of(device, &twin);
        assert!(numbered.state == State::Warning && numbered.remedy.contains("/dev/zero"), "{numbered}");
        let [name, device] = ["/dev/ttyAMA10"; 2].map(Into::into);
        let debug = of(shared, &SerialPortInfo { name, device, shared_name: None, ..twin });
        assert!(
            debug.finding.contains("debug connector") && debug.remedy.contains("/dev/ttyAMA0"),
            "{debug}"
        );
    }

    #[test]
    fn adapter_without_port_fails_only_without_other_port() {
        let adapter = PortlessAdapter {
            usb: "1-1".to_owned(),
            id: "1a86:7523".to_owned(),
            chip: "CH340",
            module: "ch341",
            reason: scanhub_port::NoPortReason::Brltty { pid: 7 },
        };
        assert_eq!(without_port(&adapter, true).state, State::Failed);
        let found = without_port(&adapter, false);
        assert!(found.state == State::Warning && found.remedy.contains("brltty"), "{found}");
    }

    #[test]
    fn warns_of_process_that_reads_port_of_hub() {
        let holder = |pid, program: &str| Holder { pid, program: program.to_owned() };
        let (manager, hub, cat) = (holder(1, "systemd"), holder(7, "scanhub"), holder(9, "cat"));
        assert_eq!(holder_finding(std::slice::from_ref(&hub), 7).state, State::Ok);
        assert_eq!(holder_finding(&[manager, hub.clone()], 7).state, State::Ok);
        let two = holder_finding(&[hub, cat], 7);
        assert!(two.state == State::Warning && two.remedy.contains("process 9 (cat)"), "{two}");
    }

    #[test]
    fn checks_line_errors_by_growth_and_share() {
        let healthy = UartCounters { received: 100_000_000, framing: 900, ..UartCounters::default() };
        let of = |counts: UartCounters, now| line_errors(Some(counts), now);
        assert_eq!(line_errors(None, 0).state, State::Skipped);
        assert_eq!(of(healthy, 0).state, State::Ok);
        assert_eq!(of(healthy, MAX_ERRORS_NOW).state, State::Ok);
        let grown = of(healthy, 40);
        assert!(grown.state == State::Warning && grown.finding.starts_with("40 errors while"), "{grown}");
        assert!(grown.remedy.contains("120 ohm"), "{grown}");
        let large = of(UartCounters { parity: 90_000, ..healthy }, 0);
        assert!(large.state == State::Warning && large.remedy.contains("cable"), "{large}");
        let lost = of(UartCounters { overrun: 10_000, buffer: 80_000, ..healthy }, 0);
        assert!(lost.state == State::Warning && lost.remedy.contains("FIFO"), "{lost}");
        assert!(lost.finding.contains("overruns 90000 in 100000000 bytes"), "{lost}");
    }

    #[test]
    fn warns_of_line_that_loses_scans() {
        let mut status = Status::default();
        assert_eq!(line_loss(&status).state, State::Ok);
        status.counters[Counter::DueOnLine] = 22_000;
        status.counters[Counter::LostOnLine] = 9_000;
        let past = line_loss(&status);
        assert!(past.state == State::Ok && past.finding.contains("9000 of 22000 scans lost"), "{past}");
        status.counters[Counter::LostPpm] = 408_000;
        status.counters[Counter::DamagedPpm] = 430_000;
        let now = line_loss(&status);
        assert!(now.state == State::Warning && now.finding.starts_with("41 % lost on the line"), "{now}");
        status.counters[Counter::DamagedPpm] = 510_000;
        let most = line_loss(&status);
        assert_eq!(most.state, State::Failed, "as of a port that no hub has: {most}");
        status.counters[Counter::LostOnLine] = 0;
        status.counters[Counter::LostPpm] = 0;
        let unknown = line_loss(&status).finding;
        assert!(unknown.ends_with("the number of lost scans is unknown"), "{unknown}");
        for word in ["cable", "FIFO", "adapter", "termination"] {
            assert!(now.remedy.contains(word), "{now}");
        }
    }

    #[test]
    fn checks_line_errors_of_hub_per_byte() {
        let mut status = Status::default();
        status.counters[Counter::BytesRead] = 1_000_000;
        status.counters[Counter::LineErrors] = 10;
        assert_eq!(hub_line_errors(&status).state, State::Ok);
        status.counters[Counter::LineErrors] = 5000;
        assert_eq!(hub_line_errors(&status).state, State::Warning);
    }
}
