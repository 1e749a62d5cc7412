//! The program: parses the command line, starts the log, calls one library function per verb, and turns its outcome
//! into lines and an exit code. The only place that sees all crates.

mod cli;
mod demo;
mod mounts;
mod own_domain;
mod replay;

use std::ffi::c_int;
use std::fs::File;
use std::io::{self, IsTerminal, Write};
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use clap::error::ErrorKind;
use rustix::process::Signal;
use scanhub_config::Config;
use scanhub_schema::{Failure, Kind, Printable, json_line};
use scanhub_shm::Domain;
use serde::Serialize;
use signal_hook::consts::{SIGHUP, SIGINT, SIGQUIT, SIGTERM, SIGUSR1};
use tracing::level_filters::LevelFilter;

use cli::{Cli, Everywhere, Verb};
use demo::DemoOptions;
use mounts::SimulatedMounts;

/// In the environment of a process that shall not outlive the one that started it.
const END_WITH_PARENT: &str = "SCANHUB_END_WITH_PARENT";

fn main() -> ExitCode {
    if std::env::var_os(END_WITH_PARENT).is_some() {
        let _ = rustix::process::set_parent_process_death_signal(Some(Signal::TERM));
    }
    let cli = match Cli::of_process() {
        Ok(cli) => cli,
        Err(error) => return refuse(&error),
    };
    start_log();
    // What these print on stdout says that they are up, and how it ended; a recording is no text.
    let quiet = match &cli.verb {
        Verb::Run(_) | Verb::Replay(_) | Verb::Simulate(_) => true,
        Verb::Record(record) => record.is_to_stdout(),
        _ => false,
    };
    scanhub_daemon::explain_bus_error(cli.everywhere.json, quiet);
    match dispatch(&cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            report(&failure, cli.everywhere.json, quiet);
            ExitCode::from(failure.kind.exit_code())
        }
    }
}

fn dispatch(cli: &Cli) -> Result<(), Failure> {
    let everywhere = &cli.everywhere;
    // A file that may not grow is an error of its write, and no end.
    interrupt_by(&[SIGXFSZ])?;
    // Without the standard library's buffer, which cuts at line feeds: one write is one sample, a raw one too.
    let stdout = io::stdout().as_fd().try_clone_to_owned().map(File::from);
    let mut out = stdout.map_err(|error| Failure::new(Kind::Failed, format!("no stdout: {error}"), ""))?;
    let (json, mut notes) = (everywhere.json, io::stderr());
    match &cli.verb {
        Verb::Run(run) => run_hub(run, everywhere),
        Verb::Replay(replay) => replay::replay(replay, everywhere),
        Verb::Demo(demo) => {
            let options = DemoOptions {
                headless: demo.headless,
                run_for: demo.run_for,
                world: demo.world,
                seed: demo.seed,
                family: demo.family,
                json: everywhere.json,
            };
            // Without a picture it may be meant to outlive its terminal.
            let stop = if demo.headless { interrupt() } else { interrupt_by(&ENDS) };
            demo::demo(&options, &mut out, &*stop?)
        }
        Verb::Simulate(simulate) => run_simulator(simulate, everywhere),
        Verb::Telegram(telegram) => telegram.run(json, &mut out),
        Verb::Probe(probe) => probe.run(json, || everywhere.places(), &mut out, &*interrupt()?),
        Verb::Configure(configure) => {
            configure.run(json, &everywhere.places()?, &mut out, &*interrupt_by(&ENDS)?)
        }
        Verb::Convert(convert) => convert.run(everywhere.json, &*interrupt()?),
        Verb::Completions(completions) => completions.run(),
        Verb::Complete(complete) => {
            complete.run();
            Ok(())
        }
        Verb::Man(man) => man.run(),
        Verb::Config(config) => config.run(everywhere),
        Verb::Doctor { args, run } => {
            let domains = (everywhere.hub_domain()?, everywhere.places()?);
            args.run(&run.sources(), domains, json, &mut out, &*interrupt()?)
        }
        Verb::List(list) => {
            list.run(json, &everywhere.domain, everywhere.root.as_deref(), &mut out, interrupt)
        }
        Verb::Info(info) => info.run(json, &everywhere.places()?, &mut out, &*interrupt()?),
        Verb::Echo(echo) => echo.run(json, &everywhere.places()?, &mut out, &mut notes, &*interrupt()?),
        Verb::Hz(hz) => hz.run(json, &everywhere.places()?, &mut out, &mut notes, &*interrupt()?),
        Verb::Latency(latency) => {
            latency.run(json, out.is_terminal(), &everywhere.places()?, &mut out, &mut notes, &*interrupt()?)
        }
        // Every signal that ends it must restore the terminal.
        Verb::Watch(watch) => {
            watch.run(&everywhere.places()?, everywhere.json, &mut out, &*interrupt_by(&ENDS)?)
        }
        Verb::Web(web) => replay::page::run(web, everywhere, &mut out, &interrupt()?),
        // Whatever ends it, the file is finished.
        Verb::Record(record) => {
            record.run(json, &everywhere.places()?, &mut out, &mut notes, &*interrupt_by(&ENDS)?)
        }
        Verb::Control(control) => control.run(json, &everywhere.places()?, &mut out, &*interrupt()?),
        Verb::Bridge(bridge) => bridge.run(everywhere).map(|never| match never {}),
        Verb::Key(key) => key.run(everywhere.json, &mut out),
        Verb::Background(background) => {
            background.run(json, &everywhere.places()?, &mut io::stdin(), &mut out, interrupt)
        }
        Verb::Zones(zones) => {
            let mut progress = scanhub_tools::Progress::on_stderr();
            let mut show = |state: Option<&str>| match state {
                Some(state) => progress.show(state),
                None => progress.clear(),
            };
            zones.run(json, &everywhere.places()?, &mut out, &mut notes, &mut show, &*interrupt()?)
        }
        Verb::Track(track) => track.run(json, &everywhere.places()?, &mut out, &mut notes, &*interrupt()?),
        Verb::Tilt(tilt) => tilt.run(json, &everywhere.places()?, &mut out, &mut notes, &*interrupt()?),
        Verb::Site(site) => site.run(json, &mut out),
        Verb::Leds(leds) => leds.run(json, &everywhere.places()?, &mut out, &mut notes, &*interrupt()?),
        Verb::Gateway(gateway) => {
            let (tell, stop) = (interrupt_by(&[SIGUSR1])?, interrupt()?);
            gateway.args()?.run(&everywhere.verb(), &mut out, &mut io::stderr(), &tell, &stop)
        }
        Verb::Listen(listen) => {
            let (tell, stop) = (interrupt_by(&[SIGUSR1])?, interrupt()?);
            listen.run(&everywhere.verb(), &mut out, &mut io::stderr(), &tell, &stop)
        }
    }
}

fn run_hub(run: &cli::Run, everywhere: &Everywhere) -> Result<(), Failure> {
    let read = || Config::load(&run.sources());
    let domain = everywhere.hub_domain()?;
    scanhub_daemon::run(&read, &domain, |ready| say_ready(ready, &domain, everywhere.json))
}

/// Says that a hub is up.
fn say_ready(ready: &scanhub_daemon::Ready, domain: &Domain, json: bool) {
    say(&if json {
        line(&HubReady {
            class: "ready",
            domain: domain.name(),
            root: domain.root(),
            pid: std::process::id(),
            boot: format!("{:016x}", ready.boot),
            sensors: &ready.sensors,
            waiting: &ready.waiting,
        })
    } else {
        let place = domain.root().display();
        let without_port: Vec<_> =
            ready.waiting.iter().filter(|name| !ready.taken.contains(name)).cloned().collect();
        let waiting = |what: &str, names: &[String]| match names {
            [] => String::new(),
            names => format!("; waiting for the {what} of {}", names.join(", ")),
        };
        let (ports, names) = (waiting("port", &without_port), waiting("name", &ready.taken));
        format!("ready {} in {place}, sensors: {}{ports}{names}", domain.name(), ready.sensors.join(", "))
    });
}

fn run_simulator(simulate: &cli::simulate::Simulate, everywhere: &Everywhere) -> Result<(), Failure> {
    let options = simulate.options()?;
    let (stop, write) = UnixStream::pair().map_err(no_handler)?;
    for signal in [SIGINT, SIGTERM] {
        let write = write.try_clone().map_err(no_handler)?;
        signal_hook::low_level::pipe::register(signal, write).map_err(no_handler)?;
    }
    let announce = |ready: &[scanhub_sim::Ready]| {
        if everywhere.json {
            let ports =
                ready.iter().map(|one| ReadyPort { port: &one.port, pty: one.pty.as_deref() }).collect();
            say(&line(&SimulatorReady { class: "ready", ports }));
        } else {
            let ports: Vec<_> = ready.iter().map(|one| one.port.display().to_string()).collect();
            say(&format!("ready {}", ports.join(" ")));
        }
    };
    let mounts = SimulatedMounts::start(&simulate.angles, &options, &everywhere.publisher_domain()?)?;
    let report = |number, report| mounts.report(number, report);
    scanhub_sim::simulate_with(&options, &stop, announce, |_| {}, |_| None, report).map(drop)
}

/// The line that says that the hub is up; keys in the order of their contract.
#[derive(Serialize)]
struct HubReady<'a> {
    class: &'static str,
    domain: &'a str,
    root: &'a Path,
    pid: u32,
    boot: String,
    sensors: &'a [String],
    waiting: &'a [String],
}

/// The line that says that the simulator is up.
#[derive(Serialize)]
struct SimulatorReady<'a> {
    class: &'static str,
    ports: Vec<ReadyPort<'a>>,
}

#[derive(Serialize)]
struct ReadyPort<'a> {
    port: &'a Path,
    #[serde(skip_serializing_if = "Option::is_none")]
    pty: Option<&'a Path>,
}

fn line(value: &impl Serialize) -> String {
    json_line(serde_json::to_string(value).unwrap_or_default())
}

/// A file would become longer than is allowed; signal-hook has no name for it.
const SIGXFSZ: c_int = Signal::XFSZ.as_raw();
/// Whatever asks a process to end.
const ENDS: [c_int; 4] = [SIGINT, SIGTERM, SIGHUP, SIGQUIT];

/// A flag that SIGINT and SIGTERM set; either one also ends a wait.
fn interrupt() -> Result<Arc<AtomicBool>, Failure> {
    interrupt_by(&[SIGINT, SIGTERM])
}

/// The same of these signals, none of which ends the process then: a change of an EEPROM goes to its end, also when its
/// terminal is closed.
fn interrupt_by(signals: &[c_int]) -> Result<Arc<AtomicBool>, Failure> {
    let flag = Arc::new(AtomicBool::new(false));
    for signal in signals {
        signal_hook::flag::register(*signal, flag.clone()).map_err(no_handler)?;
    }
    Ok(flag)
}

fn no_handler(error: io::Error) -> Failure {
    Failure::new(Kind::Failed, format!("no signal handler: {error}"), "")
}

/// Writes to stdout what the verb is for; whoever closed it does not want it.
///
/// [`Kind::Failed`] if it cannot be written, as on a full disk.
fn print(text: &str) -> Result<(), Failure> {
    print_own(&Printable(text).to_string())
}

/// The same of text that is all ours, which may have tabs.
fn print_own(text: &str) -> Result<(), Failure> {
    match io::stdout().lock().write_all(format!("{text}\n").as_bytes()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(Failure::new(Kind::Failed, format!("cannot write: {error}"), ""))
        }
        _ => Ok(()),
    }
}

/// Writes one line to stdout; whoever closed it does not want it.
fn say(line: &str) {
    let _ = io::stdout().lock().write_all(format!("{}\n", Printable(line)).as_bytes());
}

fn report(failure: &Failure, json: bool, quiet: bool) {
    match (json, quiet) {
        (true, false) => say(&scanhub_verbs::error_line(failure)),
        (true, true) => complain(&scanhub_verbs::error_line(failure)),
        (false, _) => complain(&format!("scanhub: {failure}")),
    }
}

/// Writes one line to stderr, which may be a terminal that is gone.
fn complain(line: &str) {
    let _ = io::stderr().lock().write_all(format!("{}\n", Printable(line)).as_bytes());
}

/// The command line cannot be understood, or asks for help only.
fn refuse(error: &clap::Error) -> ExitCode {
    let wants_text = matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion);
    if !wants_text && std::env::args_os().any(|word| word == "--json") {
        let text = error.to_string();
        let message = text.lines().next().unwrap_or_default().trim_start_matches("error: ");
        let tip = text.lines().find_map(|line| line.trim_start().strip_prefix("tip: "));
        report(&Failure::new(Kind::Usage, message, tip.unwrap_or("scanhub --help")), true, false);
    } else {
        let _ = error.print();
    }
    ExitCode::from(if wants_text { 0 } else { Kind::Usage.exit_code() })
}

/// To stderr, down to the level in SCANHUB_LOG: error, warn, info (default), debug, trace, off.
fn start_log() {
    let level = std::env::var("SCANHUB_LOG").ok().and_then(|level| level.parse().ok());
    tracing_subscriber::fmt()
        .with_writer(|| replay::line::Log)
        .with_max_level(level.unwrap_or(LevelFilter::INFO))
        .with_target(false)
        .with_ansi(false)
        .init();
}
