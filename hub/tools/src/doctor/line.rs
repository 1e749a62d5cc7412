//! One port from the outside in: whether it exists, who holds it, whether this user may open it, what it can do; then the
//! sensor at its other end.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use port::{
    Candidate, Holder, PROMPT_MS, Port, PortError, PortlessAdapter, Rights, Source, all_holders, check_tty,
    latency_ms,
};
use scanhub_drivers::lms::variant::Baud;
use schema::{Failure, Kind};

use super::Subject;
use super::counts::{as_the_hub_counts, line_errors, line_loss};
use super::finding::Finding;
use super::hub::Hub;
use super::{sensor, turning};
use crate::probe::{self, Answer};

/// Examines a port and its sensor.
///
/// [`Kind::Interrupted`] if `stop` is set; everything else is a finding.
pub(crate) fn examine(
    subject: &Subject,
    there: &[Candidate],
    hub: Option<&Hub>,
    stop: &AtomicBool,
    tell: &mut dyn FnMut(Finding),
) -> Result<(), Failure> {
    let path = match &subject.source {
        Source::Tty(path) => path,
        Source::File { path, .. } => {
            tell(recording(path));
            return Ok(());
        }
        Source::Tcp { .. } => return server(subject, hub, stop, tell),
    };
    let candidate = candidate(path, there);
    if hub.is_some_and(|hub| hub.is_mute_link(&subject.source)) {
        tell(Finding::skipped("port", "a link of the hub, which does not report its port"));
        return Ok(());
    }
    if let Err(error @ (PortError::NotTty | PortError::Dead | PortError::Other(_))) = check_tty(path) {
        tell(refused(error.explain(&subject.source)));
        return Ok(());
    }
    tell(presence(&subject.source, path, candidate));
    if !path.exists() {
        return Ok(());
    }
    let holders = all_holders(path);
    if !holders.is_empty() {
        // To open it would change its settings under who has it.
        match hub.filter(|hub| holders.iter().any(|holder| holder.pid == hub.pid)) {
            Some(hub) => {
                let link = hub.link(&subject.source.name());
                let why = hub.why_unknown();
                tell(latency(path, latency_ms(path)));
                tell(held(&holders, hub.pid));
                match link {
                    Some((_, status)) => {
                        [as_the_hub_counts(status), line_loss(status)].into_iter().for_each(&mut *tell)
                    }
                    None => tell(Finding::skipped("line-errors", why)),
                }
                sensor::as_the_hub_says(link, why).into_iter().for_each(tell);
            }
            None => {
                tell(refused(PortError::Busy.explain(&subject.source)));
                tell(Finding::skipped("sensor", "its port is in use"));
            }
        }
        return Ok(());
    }
    tell(Finding::ok("holder", "nobody has it open"));
    if !subject.named {
        // To open it alone would start some devices anew.
        tell(if candidate.is_none_or(|candidate| candidate.is_permitted) {
            Finding::ok("access", "may be opened")
        } else {
            refused(PortError::Denied.explain(&subject.source))
        });
        let name = subject.source.name();
        let why = format!("not opened, because the port was not named; scanhub doctor {name} checks it");
        tell(Finding::skipped("sensor", why));
        return Ok(());
    }
    let (port, first) = match probe::open(&subject.source, stop) {
        Ok(opened) => opened,
        Err(failure) => {
            tell(refused(failure));
            return Ok(());
        }
    };
    tell(Finding::ok("access", format!("can be opened, is a serial line{}", whose(path))));
    // Opened, most adapters hand over at once.
    tell(latency(path, latency_ms(path)));
    let answer = ask(subject, &port, first, stop)?;
    // Without an answer, bytes may have arrived at another rate.
    let now = if answer.is_ok() { port.line_errors() } else { 0 };
    let found = answer.as_ref().ok().and_then(|answer| answer.0);
    tell(rate(subject, &port, first, found));
    report(answer).into_iter().for_each(&mut *tell);
    tell(line_errors(port.counts(), now));
    Ok(())
}

/// Examines a serial server and the sensor behind it.
fn server(
    subject: &Subject,
    hub: Option<&Hub>,
    stop: &AtomicBool,
    tell: &mut dyn FnMut(Finding),
) -> Result<(), Failure> {
    // Most of them serve one at a time.
    if let Some(link) = hub.and_then(|hub| hub.link(&subject.source.name())) {
        tell(Finding::ok("holder", "it is a link of the hub"));
        tell(line_loss(link.1));
        sensor::as_the_hub_says(Some(link), "").into_iter().for_each(tell);
        return Ok(());
    }
    match probe::open(&subject.source, stop) {
        Ok((port, first)) => {
            tell(Finding::ok("access", "connected; its rate was set there, by hand"));
            report(ask(subject, &port, first, stop)?).into_iter().for_each(tell);
            Ok(())
        }
        Err(failure) if failure.kind == Kind::Interrupted => Err(failure),
        Err(failure) => {
            tell(refused(failure));
            Ok(())
        }
    }
}

/// Rate at which a rotating scanner was found, and the findings about the sensor. Otherwise the reason why none answered.
type Examined = Result<(Option<u32>, Vec<Finding>), Finding>;

/// Examines the sensor at `port`, which is open at `first`.
fn ask(subject: &Subject, port: &Port, first: Baud, stop: &AtomicBool) -> Result<Examined, Failure> {
    let (source, link) = (&subject.source, subject.link.as_ref());
    match probe::find(port, first, source, link.map(config::Link::family), stop, |_| {}) {
        Ok(Answer::Asked(report)) => Ok(Ok((None, sensor::examine(&source.name(), &report, link)))),
        Ok(Answer::Heard(heard)) => Ok(Ok((Some(heard.rate), turning::examine(&heard, link)))),
        Err(failure) if failure.kind == Kind::Interrupted => Err(failure),
        Err(failure) => Ok(Err(Finding::failed("sensor", failure.message, failure.hint))),
    }
}

fn report(examined: Examined) -> Vec<Finding> {
    examined.map_or_else(|finding| vec![finding], |(_, findings)| findings)
}

/// The hub has it; whoever has it too takes bytes away from it. The service manager keeps it for the next hub.
fn held(holders: &[Holder], hub: u32) -> Finding {
    const NAME: &str = "holder";
    let words: Vec<String> = holders.iter().map(ToString::to_string).collect();
    let other = holders.iter().find(|holder| holder.pid != hub && holder.pid != SERVICE_MANAGER);
    match other {
        None => Finding::ok(NAME, format!("the hub has it, {}", words.join(", "))),
        Some(other) => Finding::warning(
            NAME,
            format!("another process reads the port: {}", words.join(", ")),
            format!("end {other}: the hub loses every byte that it reads"),
        ),
    }
}

/// Group and mode of the port, in words.
fn whose(path: &Path) -> String {
    let rights = Rights::of(path);
    rights.port.map_or(String::new(), |port| format!("; group {}, mode {:03o}", rights.group, port.mode))
}

fn recording(path: &Path) -> Finding {
    if path.is_file() {
        Finding::ok("port", "a recording")
    } else {
        Finding::failed("port", "no such file", "name an existing recording")
    }
}

/// What the machine knows of the port.
fn candidate<'a>(path: &Path, there: &'a [Candidate]) -> Option<&'a Candidate> {
    let device = path.canonicalize().ok()?;
    there.iter().find(|candidate| candidate.device == device)
}

/// Reports an adapter without a port, which is a failure if there is no other port to examine.
pub(crate) fn without_port(adapter: &PortlessAdapter, is_only: bool) -> Finding {
    let finding = if is_only { Finding::failed } else { Finding::warning };
    finding("ports", adapter.to_string(), adapter.remedy())
}

/// Whether it is there, and under a name that stays.
fn presence(source: &Source, path: &Path, candidate: Option<&Candidate>) -> Finding {
    const NAME: &str = "port";
    if !path.exists() {
        return refused(PortError::Missing.explain(source));
    }
    let Some(Candidate { name, device, .. }) = candidate else {
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

fn describe(candidate: &Candidate) -> String {
    let Candidate { device, driver, product, .. } = candidate;
    let mut text = device.display().to_string();
    for word in [product, driver].into_iter().flatten() {
        text = format!("{text}, {word}");
    }
    text
}

/// Why it cannot be opened.
fn refused(failure: Failure) -> Finding {
    let name = match failure.kind {
        Kind::PortBusy => "holder",
        Kind::PortMissing => "port",
        Kind::PortRate => "rate",
        _ => "access",
    };
    Finding::failed(name, failure.message, failure.hint)
}

/// Whether the adapter of an open port collects bytes, for so many milliseconds, before it hands them over.
fn latency(path: &Path, ms: Option<u8>) -> Finding {
    const NAME: &str = "latency";
    let Some(ms) = ms else { return Finding::skipped(NAME, "the driver has no latency timer") };
    if ms <= PROMPT_MS {
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

/// Checks whether the port can have the rate to stream at: the rate of the rotating scanner that was `found`, or the link's rate.
fn rate(subject: &Subject, port: &Port, first: Baud, found: Option<u32>) -> Finding {
    const NAME: &str = "rate";
    let link_rate = subject.link.as_ref().map_or(Baud::B500000.rate(), config::Link::rate);
    let wanted = found.unwrap_or(link_rate);
    let outcome = port.set_baud(wanted);
    let given = port.baud().filter(|&given| given != wanted);
    // The inquiry begins at the rate at which it was opened.
    let _ = port.set_baud(first.rate());
    match (outcome, &subject.link) {
        (Ok(()), _) => {
            let near =
                given.map_or(String::new(), |given| format!(": the driver sets {given} Bd, close enough"));
            let state = if found.is_some() { "in use" } else { "possible" };
            Finding::ok(NAME, format!("{wanted} Bd is {state}{near}"))
        }
        (Err(error), Some(link)) if link.scanner != config::Scanner::Lms => Finding::failed(
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

/// The first process of all: it has lines open only for a service.
const SERVICE_MANAGER: u32 = 1;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::finding::State;

    #[test]
    fn what_the_hub_does_not_mind_is_no_finding() {
        let of = |ms| latency(Path::new("/dev/ttyUSB0"), ms);
        assert_eq!([of(None).state, of(Some(1)).state], [State::Skipped, State::Ok]);
        assert_eq!(of(Some(PROMPT_MS)).state, State::Ok);
        let slow = of(Some(16));
        assert_eq!(slow.state, State::Warning);
        assert!(slow.remedy.contains("/sys/class/tty/ttyUSB0/device/latency_timer"), "{slow}");
    }

    #[test]
    fn a_name_that_may_stand_for_another_port_is_reported() {
        // Files that exist everywhere stand for the names.
        let [device, by_path, shared] = ["/dev/null", "/dev/zero", "/dev/full"].map(Path::new);
        let twin = Candidate {
            name: by_path.to_owned(),
            device: device.to_owned(),
            shared_name: Some(shared.to_owned()),
            driver: Some("cp210x".to_owned()),
            product: None,
            holder: None,
            is_permitted: true,
        };
        let of = |path: &Path, port: &Candidate| presence(&Source::Tty(path.to_owned()), path, Some(port));
        let found = of(shared, &twin);
        assert!(found.state == State::Warning && found.finding.contains("same serial number"), "{found}");
        assert!(found.remedy.contains("/dev/zero"), "{found}");
        assert_eq!(of(by_path, &twin).state, State::Ok);
        let numbered = of(device, &twin);
        assert!(numbered.state == State::Warning && numbered.remedy.contains("/dev/zero"), "{numbered}");
        let [name, device] = ["/dev/ttyAMA10"; 2].map(Into::into);
        let debug = of(shared, &Candidate { name, device, shared_name: None, ..twin });
        assert!(
            debug.finding.contains("debug connector") && debug.remedy.contains("/dev/ttyAMA0"),
            "{debug}"
        );
    }

    #[test]
    fn adapters_without_a_port_fail_only_if_there_is_none() {
        let adapter = PortlessAdapter {
            usb: "1-1".to_owned(),
            id: "1a86:7523".to_owned(),
            chip: "CH340",
            module: "ch341",
            reason: port::Reason::Brltty { pid: 7 },
        };
        assert_eq!(without_port(&adapter, true).state, State::Failed);
        let found = without_port(&adapter, false);
        assert!(found.state == State::Warning && found.remedy.contains("brltty"), "{found}");
    }

    #[test]
    fn who_reads_beside_the_hub_is_told() {
        let holder = |pid, program: &str| Holder { pid, program: program.to_owned() };
        let (manager, hub, cat) = (holder(1, "systemd"), holder(7, "scanhub"), holder(9, "cat"));
        assert_eq!(held(std::slice::from_ref(&hub), 7).state, State::Ok);
        assert_eq!(held(&[manager, hub.clone()], 7).state, State::Ok);
        let two = held(&[hub, cat], 7);
        assert!(two.state == State::Warning && two.remedy.contains("process 9 (cat)"), "{two}");
    }
}
