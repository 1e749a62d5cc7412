//! `scanhub simulate`, which simulates scanners and the mounts that tilt them.

use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{Arg, ArgAction, Args};
use scanhub_schema::Failure;
use scanhub_sim::fault::Faults;
use scanhub_sim::options::{self, SimulateOptions};
use scanhub_verbs::context::Context;
use scanhub_verbs::duration;
use serde::Serialize;
use signal_hook::consts::{SIGINT, SIGTERM};

use crate::mounts::SimulatedMounts;
use crate::{no_handler, print_status, to_json_line};

/// Simulate scanners on virtual serial ports (ptys) or TCP ports
#[derive(Args, Debug)]
#[command(group = clap::ArgGroup::new("place").args(["port", "tcp"]).required(true).multiple(true))]
#[command(disable_help_flag = true, arg = help_flag(), arg = help_faults_flag())]
#[command(after_help = EXAMPLES, after_long_help = after_long_help())]
pub(crate) struct Simulate {
    /// Create a pty for a scanner, and a symlink to it at this path. Can be repeated
    #[arg(long, value_name = "PATH")]
    port: Vec<PathBuf>,
    /// TCP address at which a scanner is offered, as behind a serial server. Port 0: any free port, which the line
    /// `ready` shows. A hub opens the scanner as tcp:HOST:PORT. Scanners of --tcp are numbered after those of --port
    #[arg(long, value_name = "HOST:PORT")]
    tcp: Vec<String>,
    /// Baud rate of the line at the start: 9600, 19200, 38400 or 500000 [default: the permanent rate]
    #[arg(long, hide_short_help = true, value_name = "RATE")]
    baud: Option<String>,
    /// Baud rate after power-on, as stored in the EEPROM [default: 9600]
    #[arg(long, hide_short_help = true, value_name = "RATE")]
    permanent_baud: Option<String>,
    /// State of the scanners at the start: idle, streaming, partial, means, range, mean-range, fields, reflectivity or
    /// installation, as an earlier host left them; or starting, for a power-on
    #[arg(long, hide_short_help = true, default_value = "idle", value_name = "STATE")]
    state: String,
    /// Time from power-on to the boot message
    #[arg(long, hide_short_help = true, default_value = "2s", value_name = "DURATION", value_parser = duration::parse)]
    boot: Duration,
    /// Address of the scanners, 0 to 127. They also reply to requests to address 0
    #[arg(long, hide_short_help = true, default_value_t = 0, value_name = "NUMBER")]
    address: u8,
    /// Simulated surroundings: room, bare, fig8, standing, approach, door, corridor, glass, faint, sun, chair, strips,
    /// crowd, demo, house, tilt, empty, wall640 or random; or a TOML file (docs/worlds.md)
    #[arg(long, default_value = "room", value_name = "NAME|FILE", conflicts_with = "replay")]
    world: String,
    /// Publish the angles of a tilting mount as NAME/tilt in the domain of --domain. Give one name for each port, in the same
    /// order. docs/worlds.md lists the worlds with a mount
    #[arg(long, value_name = "NAME", conflicts_with = "replay")]
    pub(crate) angles: Vec<String>,
    /// Recording to send instead of a simulated world: MCAP file, stream file or CARMEN log, plain or gzipped. Family
    /// ld: an MCAP file or raw bytes. Not available for rplidar
    #[arg(long, value_name = "FILE")]
    replay: Option<PathBuf>,
    /// Sensor of the recording, if it has several: one for all ports, or one for each port, in the same order
    #[arg(long, value_name = "NAME")]
    sensor: Vec<String>,
    /// Restart the recording at its end
    #[arg(long = "loop")]
    looped: bool,
    /// Speed relative to real time. It also changes the time of a bit on the line
    #[arg(long, default_value_t = 1.0, value_name = "FACTOR")]
    speed: f64,
    /// Seed of worlds, delays and faults
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Inject faults, for example loss=0.00135,burst=1.89. --help-faults lists them
    #[arg(long, default_value = "", hide_default_value = true, value_name = "KEY=VALUE,..")]
    fault: String,
    /// Write a JSON line for each sent telegram, with its hash, to this file. `-` is stdout
    #[arg(long, hide_short_help = true, value_name = "FILE")]
    truth: Option<PathBuf>,
    /// Overwrite an existing file of --truth
    #[arg(long, hide_short_help = true, requires = "truth")]
    force: bool,
    /// Family of the scanners: lms (SICK LMS 2xx), ld (LDROBOT) or rplidar (Slamtec)
    #[arg(long, default_value = options::DEFAULT_FAMILY, value_name = "FAMILY")]
    family: String,
    /// Model. Family ld: ld06, ld19, stl19p, stl27l or ld14p [default: ld19]. Family rplidar: a1, a2m8, a2m12, a3, s1, s2, s3
    /// or c1 [default: a1]
    #[arg(long, value_name = "NAME")]
    model: Option<String>,
    /// Type of the scanners, for family lms: lms200, lms211, lms221 or lms291. It limits what the scanners support
    #[arg(long = "type", default_value = options::DEFAULT_TYPE, value_name = "TYPE")]
    scanner_type: String,
    /// Angle and resolution, for family lms [default: that of the recording, or 180/0.5; lms211: 100/0.5]
    #[arg(long, value_name = "DEGREES/STEP")]
    variant: Option<String>,
    /// Unit, for family lms: mm, cm or dm [default: that of the recording, or cm; lms200: mm]
    #[arg(long)]
    unit: Option<String>,
    /// Measuring mode. Family lms: a byte [default: that of the recording, or 0x01]. Family rplidar: name of the scan mode that
    /// the scanner recommends, such as Boost [default: that of the model]
    #[arg(long, value_name = "MODE")]
    mode: Option<String>,
    /// Add the scan index and the telegram index after the measured values
    #[arg(long, hide_short_help = true)]
    indices: bool,
    /// Report a configuration of 32 bytes, as older firmware does
    #[arg(long, hide_short_help = true)]
    short_configuration: bool,
    /// Status byte at the end of each reply: 0x10 healthy, 0x11 info, 0x12 warning, 0x13 error
    #[arg(long, hide_short_help = true, default_value = "0x10", value_name = "BYTE")]
    status: String,
    /// Error that the scanners report, such as 3:18, or 0x84:22 for a past error. Can be repeated
    #[arg(long, hide_short_help = true, value_name = "TYPE:NUMBER")]
    error: Vec<String>,
    /// Transparency of the front window in percent. The scanner reports a warning below 75, an error below 30
    #[arg(long, hide_short_help = true, default_value_t = 100, value_name = "PERCENT")]
    pollution: u16,
    /// Size of the pieces in which bytes arrive: uart (16 bytes) or usb (62 bytes)
    #[arg(long, hide_short_help = true, default_value = "uart", value_name = "KIND")]
    chunk: String,
    /// Lose no bytes while the hub does not read: the scanners wait. A real line loses them. For tests on a busy machine
    #[arg(long, hide_short_help = true)]
    lossless: bool,
}

impl Simulate {
    /// Simulates until SIGINT or SIGTERM.
    pub(crate) fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let options = self.options()?;
        let (stop, write) = UnixStream::pair().map_err(no_handler)?;
        for signal in [SIGINT, SIGTERM] {
            let write = write.try_clone().map_err(no_handler)?;
            signal_hook::low_level::pipe::register(signal, write).map_err(no_handler)?;
        }
        let announce = |ready: &[scanhub_sim::SimulatedPort]| {
            if context.json {
                let ports =
                    ready.iter().map(|one| ReadyPort { port: &one.port, pty: one.pty.as_deref() }).collect();
                print_status(&to_json_line(&SimulatorReady { class: "ready", ports }));
            } else {
                let ports: Vec<_> = ready.iter().map(|one| one.port.display().to_string()).collect();
                print_status(&format!("ready {}", ports.join(" ")));
            }
        };
        let mounts = SimulatedMounts::start(&self.angles, &options, &context.domain.of_publisher()?)?;
        let report = |number, report| mounts.report(number, report);
        scanhub_sim::simulate_with(&options, &stop, announce, |_| {}, |_| None, report).map(drop)
    }

    fn options(&self) -> Result<SimulateOptions, Failure> {
        let servers = self.tcp.iter().map(|address| format!("tcp:{address}").into());
        let mode = self.mode.as_deref();
        let scanner = options::parse_family(&self.family, self.model.as_deref(), mode)?;
        Ok(SimulateOptions {
            ports: self.port.iter().cloned().chain(servers).collect(),
            baud: self.baud.as_deref().map(options::parse_baud).transpose()?,
            permanent_baud: self.permanent_baud.as_deref().map(options::parse_baud).transpose()?,
            state: options::parse_state(&self.state)?,
            boot: self.boot,
            address: self.address,
            world: self.world.parse()?,
            replay: self.replay.clone(),
            sensors: self.sensor.clone(),
            looped: self.looped,
            speed: self.speed,
            seed: self.seed,
            faults: self.fault.parse()?,
            truth: self.truth.clone(),
            force: self.force,
            family: options::parse_type(&self.scanner_type)?,
            variant: self.variant.as_deref().map(options::parse_variant).transpose()?,
            unit: self.unit.as_deref().map(options::parse_unit).transpose()?,
            mode: mode.filter(|_| scanner.is_none()).map(options::parse_mode).transpose()?,
            indices: self.indices,
            short_configuration: self.short_configuration,
            status: options::parse_byte("status", &self.status)?,
            errors: self.error.iter().map(|text| options::parse_error(text)).collect::<Result<_, _>>()?,
            pollution: self.pollution,
            chunk: self.chunk.parse()?,
            lossless: self.lossless,
            scanner,
        })
    }
}

/// JSON line of class `ready`.
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

const EXAMPLES: &str = "\
Examples:
  scanhub simulate --port /tmp/front --world room
  scanhub simulate --port /tmp/front --fault loss=0.00135,burst=1.89
  scanhub simulate --port /tmp/front --replay robot.mcap --sensor front
  scanhub simulate --family rplidar --model a1 --tcp 127.0.0.1:0";

/// Returns the flag for the help without rare flags and faults.
fn help_flag() -> Arg {
    let flag = Arg::new("help").short('h').long("help").action(ArgAction::HelpShort);
    flag.help("Print help").display_order(1000)
}

/// Returns the flag for the complete help. clap's long help has the flags that its short help hides.
fn help_faults_flag() -> Arg {
    let flag = Arg::new("help_faults").long("help-faults").action(ArgAction::HelpLong);
    flag.help("Print help with rare flags and all faults").display_order(1001)
}

/// Returns the examples and the table of faults, for the end of the complete help.
fn after_long_help() -> String {
    let rows = Faults::keys().map(|(key, meaning)| format!("  {key:14} {meaning}"));
    format!("{EXAMPLES}\n\nFaults:\n{}", rows.collect::<Vec<_>>().join("\n"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn help_names_every_world() {
        let command = Simulate::augment_args(clap::Command::new("simulate"));
        let world = command.get_arguments().find(|argument| argument.get_id() == "world").expect("an option");
        let help = world.get_help().expect("a help").to_string();
        let words: Vec<&str> = help.split([' ', ',', ';']).collect();
        for name in scanhub_sim::world::World::names() {
            assert!(words.contains(&name), "{name} is not in: {help}");
        }
    }
    #[test]
    fn rare_flags_and_faults_are_in_help_faults_only() {
        let help = |flag| {
            let command = Simulate::augment_args(clap::Command::new("simulate"));
            let shown = command.try_get_matches_from(["simulate", flag]).expect_err("the help");
            assert_eq!(shown.kind(), clap::error::ErrorKind::DisplayHelp, "{flag}");
            shown.to_string()
        };
        let (usual, all) = (help("--help"), help("--help-faults"));
        for rare in ["--permanent-baud", "--short-configuration", "--lossless", "brownout_every"] {
            assert!(!usual.contains(rare) && all.contains(rare), "{rare}");
        }
        for flag in ["--port <", "--world <", "--fault <", "--help-faults"] {
            assert!(usual.contains(flag) && all.contains(flag), "{flag}");
        }
        assert_eq!(help("-h"), usual);
    }
}
