//! `scanhub leds`: shows the zone verdict and the mark count of a sensor as lights, in the terminal and on LEDs of the
//! machine. The lights never show a better state than the program knows: the red light is on at the start, at the end,
//! and while the hub is silent.

mod device;

use std::io::{self, Write};
use std::mem;
use std::path::PathBuf;
use std::rc::Rc;
use std::time::{Duration, Instant};

use clap::Args;
use scanhub_client::clock;
use scanhub_client::streams::{Sample, StalenessTimer};
use scanhub_schema::{Failure, Kind, ROBOT, Status, Topic, Verdict, check_any_sensor};
use serde::Serialize;

use self::device::{Device, DeviceEvent};
use crate::context::Context;
use crate::follow::{Event, Notice, RunLimits, TopicRun};
use crate::names::{TopicName, as_argument};
use crate::output::{ExitReason, Output, colors, verb_result};
use crate::{duration, json, text};

/// Show the zone verdict and the marks as lights, in the terminal and on LEDs of this machine
#[derive(Args, Clone, Debug)]
#[command(after_help = AFTER_HELP)]
pub struct LedsArgs {
    /// Sensor, or robot for the combined verdict of all sensors
    sensor: String,
    /// LEDs of this machine that also show the lights: green=NAME, yellow=NAME, red=NAME, mark=NAME, separated by
    /// commas. After the run, the red LED stays on
    #[arg(long = "led", value_name = "LIGHT=NAME", value_delimiter = ',')]
    leds: Vec<String>,
    /// Directory of the LEDs
    #[arg(long, default_value = "/sys/class/leds", value_name = "DIR")]
    led_root: PathBuf,
    /// Time that a better verdict must last before it is shown. A worse verdict is shown at once
    #[arg(long, default_value = "300ms", value_name = "DURATION", value_parser = duration::parse)]
    hold: Duration,
    /// Include early warnings, which arrive before a scan is complete (docs/early.md)
    #[arg(long)]
    early: bool,
    #[command(flatten)]
    limits: RunLimits,
}

const AFTER_HELP: &str = "\
Examples:
  scanhub leds front
  scanhub leds robot --led green=led0

Lights: green for clear, yellow for slow, red for stop or unknown, mark for at least one reflector mark";

impl LedsArgs {
    /// Shows the lights on stdout and on the LEDs until the limits are reached or a signal ends the run. Notices go to
    /// stderr without `--json`. The red light is on after the run, however it ends. If an LED fails during the run, the
    /// verb reports the failure and tries the LED again later. The other LEDs continue.
    ///
    /// # Errors
    ///
    /// - [`Kind::Configuration`] if an LED does not exist or its light is unknown.
    /// - [`Kind::Failed`] if this user may not switch an LED.
    /// - The errors of [`echo`](crate::echo::EchoArgs::run).
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let (locations, stop) = (context.domain.locations()?, context.signals.stop()?);
        let sensor = &self.sensor;
        let topics = if sensor == ROBOT { &[Topic::Zones][..] } else { &[Topic::Zones, Topic::Marks] };
        if sensor != ROBOT {
            as_argument(check_any_sensor(sensor))?;
        }
        let names: Vec<_> = topics.iter().map(|&topic| TopicName { sensor: sensor.clone(), topic }).collect();
        let selected = self.selected_leds()?;
        let mut panel = LightPanel {
            sensor,
            display: match (context.json, context.is_terminal) {
                (true, _) => LightDisplay::Json,
                (false, true) => LightDisplay::Terminal { colors: colors() },
                (false, false) => LightDisplay::Lines,
            },
            states: LightStates::UNKNOWN,
            verdict: WorstVerdictHold::new(self.hold),
            marks: StalenessTimer::new(clock::now()),
            losses: Vec::new(),
            devices: Vec::new(),
            out: Output::new(&mut context.out),
            notes: Output::new(&mut context.notes),
        };
        let mut following = TopicRun::new(&names, &[], &locations, &self.limits, &stop).with_lines();
        if self.early {
            following = following.with_early();
        }
        let end = panel.open(self, &selected).and_then(|()| panel.run(&mut following));
        verb_result(end.and(panel.show_unwatched()))
    }

    /// Returns light and name of each `--led`. A name may occur only once, because an LED cannot show two lights.
    fn selected_leds(&self) -> Result<Vec<(Light, &str)>, Failure> {
        let mut selected: Vec<(Light, &str)> = Vec::new();
        for led in &self.leds {
            let refuse = |hint: &str| {
                Err(Failure::new(Kind::Configuration, format!("--led {led} cannot be shown"), hint))
            };
            let Some((light, name)) = led.split_once('=') else { return refuse(LED_FORM) };
            let Some(light) = Light::ALL.into_iter().find(|it| it.name() == light) else {
                return refuse(&format!("no light {light:?}: {LED_FORM}"));
            };
            if light == Light::Mark && self.sensor == ROBOT {
                return refuse("marks belong to one sensor: name the sensor");
            }
            if let Some((other, _)) = selected.iter().find(|(_, taken)| *taken == name) {
                return refuse(&format!(
                    "{name} already shows {}: each light has its own LEDs",
                    other.name()
                ));
            }
            selected.push((light, name));
        }
        Ok(selected)
    }
}

const LED_FORM: &str = "green=NAME, yellow=NAME, red=NAME or mark=NAME, with a NAME from /sys/class/leds";

/// Form of the lights on stdout.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum LightDisplay {
    /// Text: one line for each change.
    Lines,
    /// JSON: one line for each change.
    Json,
    /// One line, which is redrawn.
    Terminal {
        /// Whether a light that is on is shown in its color.
        colors: bool,
    },
}

/// The lights with their state, and the devices that show them.
struct LightPanel<'a> {
    sensor: &'a str,
    display: LightDisplay,
    states: LightStates,
    verdict: WorstVerdictHold,
    /// Staleness of the mark count, independent of the zones.
    marks: StalenessTimer,
    /// Each sensor whose line loses data: its name, and a text about the loss.
    losses: Vec<(String, String)>,
    devices: Vec<(Light, String, Device)>,
    out: Output<'a>,
    notes: Output<'a>,
}

impl LightPanel<'_> {
    /// Opens the LEDs, and shows the unknown state.
    fn open(&mut self, args: &LedsArgs, selected: &[(Light, &str)]) -> Result<(), ExitReason> {
        for &(light, name) in selected {
            let (device, trigger) = Device::open(&args.led_root, name)?;
            self.devices.push((light, name.to_owned(), device));
            if let Some(trigger) = trigger {
                self.note(&format!("{name} was controlled by {trigger}, and now shows {}", light.name()))?;
            }
        }
        self.show(LightStates::UNKNOWN, true)
    }

    /// Shows the held verdict and the number of marks.
    fn show_known(&mut self, marks: Option<usize>, now: Instant) -> Result<(), ExitReason> {
        let (verdict, worst) = self.verdict.shown(now).clone();
        self.show(LightStates { verdict, marks, worst }, false)
    }

    /// Shows `states` if they differ from the states that are shown, or if `always` is set.
    fn show(&mut self, states: LightStates, always: bool) -> Result<(), ExitReason> {
        if self.states == states && !always {
            return Ok(());
        }
        self.states = states;
        // Switch the LEDs first, because output may be slow.
        self.switch(Instant::now())?;
        self.draw()
    }

    fn switch(&mut self, now: Instant) -> Result<(), ExitReason> {
        let mut changes = Vec::new();
        for (light, name, device) in &mut self.devices {
            if let Some(event) = device.show(self.states.is_on(*light), now) {
                changes.push((*light, name.clone(), event));
            }
        }
        changes.into_iter().try_for_each(|(light, name, event)| self.report(light, &name, event))
    }

    /// Reports that an LED failed or works again.
    fn report(&mut self, light: Light, name: &str, event: DeviceEvent) -> Result<(), ExitReason> {
        let (state, failure) = match event {
            DeviceEvent::Failed(failure) => ("failed", Some(failure)),
            DeviceEvent::Recovered => ("recovered", None),
        };
        if self.display == LightDisplay::Json {
            let (message, hint) = failure.map(|it| (it.message, it.hint)).unzip();
            return self.out.json(&LedJson { class: "led", light: light.name(), name, state, message, hint });
        }
        self.note(&failure.map_or(format!("{name} has recovered"), |failure| failure.to_string()))
    }

    /// Writes a line to `notes`. The lights are redrawn after it.
    fn note(&mut self, what: &str) -> Result<(), ExitReason> {
        self.clear_line()?;
        self.notes.line(|line| write!(line, "{what}"))
    }

    fn draw(&mut self) -> Result<(), ExitReason> {
        let reason = self.reason();
        let LightPanel { sensor, states, .. } = self;
        let (sensor, reason) = (*sensor, reason.as_deref());
        match self.display {
            LightDisplay::Json => self.out.json(&LedsJson::new(sensor, states, reason)),
            LightDisplay::Lines => self.out.line(|line| states.line(line, sensor, reason, false)),
            LightDisplay::Terminal { colors } => {
                // A wrapped line could not be redrawn, so let the terminal cut it.
                let mut line = [CLEAR_LINE, b"\x1b[?7l"].concat();
                states.line(&mut line, sensor, reason, colors)?;
                line.extend(b"\x1b[?7h");
                self.out.raw(&line)
            }
        }
    }

    /// Returns a possible reason for the verdict, as text: a loss on the line of the sensor that determines the
    /// verdict, or otherwise a loss on another sensor's line.
    fn reason(&self) -> Option<String> {
        let sensor_name = self.states.worst.as_deref();
        let of_worst = self.losses.iter().find(|(sensor, _)| Some(sensor.as_str()) == sensor_name);
        let (sensor, loss) = of_worst.or(self.losses.first())?;
        let is_plain = sensor == self.sensor || Some(sensor.as_str()) == sensor_name;
        Some(if is_plain { loss.clone() } else { format!("{sensor}: {loss}") })
    }

    fn clear_line(&mut self) -> Result<(), ExitReason> {
        match self.display {
            LightDisplay::Terminal { .. } => self.out.raw(CLEAR_LINE),
            LightDisplay::Json | LightDisplay::Lines => Ok(()),
        }
    }

    /// Turns the red light on, because this program no longer receives the verdict.
    fn show_unwatched(&mut self) -> Result<(), ExitReason> {
        self.show(LightStates::UNKNOWN, false)?;
        // Switch again, because an LED may have failed before.
        self.switch(Instant::now())?;
        match self.display {
            LightDisplay::Terminal { .. } => self.out.raw(b"\n"),
            LightDisplay::Json | LightDisplay::Lines => Ok(()),
        }
    }

    fn run(&mut self, following: &mut TopicRun<'_>) -> Result<(), ExitReason> {
        while let Some(event) = following.next(self.verdict.changes_at())? {
            match event {
                Event::Sample(_, sample, _) => self.sample(&sample)?,
                Event::Notice(names, notice) => self.notice(&names, notice)?,
                Event::Line(sensor, status) => self.line(&sensor, &status)?,
                Event::Tick(now) => self.tick(now)?,
                _ => {}
            }
        }
        Ok(())
    }

    fn sample(&mut self, sample: &Sample) -> Result<(), ExitReason> {
        let now = Instant::now();
        let mut marks = self.states.marks;
        match sample {
            Sample::Zones(update) => self.verdict.take((update.zones.verdict(), None), now),
            Sample::Robot(update) => {
                let worst = update.robot.worst().map(str::to_owned);
                self.verdict.take((update.robot.verdict(), worst), now);
            }
            Sample::Marks(sample) => {
                // A mark count becomes stale after the same time as a known verdict.
                let fresh = self.marks.update(sample.header(), Verdict::Clear, clock::now());
                marks = (fresh && sample.is_available()).then(|| sample.marks().len());
            }
            _ => {}
        }
        self.show_known(marks, now)
    }

    /// Redraws when the line of `sensor` starts or stops losing data, but not when the amount of lost data changes.
    fn line(&mut self, sensor: &str, status: &Status) -> Result<(), ExitReason> {
        let known = self.losses.iter().position(|(name, _)| name == sensor);
        let loss = status.line_loss();
        let has_changed = known.is_some() != loss.is_some();
        match (known, loss) {
            (Some(at), Some(loss)) => self.losses[at].1 = loss,
            (Some(at), None) => drop(self.losses.remove(at)),
            (None, Some(loss)) => self.losses.push((sensor.to_owned(), loss)),
            (None, None) => {}
        }
        if has_changed { self.draw() } else { Ok(()) }
    }

    fn notice(&mut self, names: &[Rc<TopicName>], notice: Notice) -> Result<(), ExitReason> {
        // Missed samples do not matter, because the lights show only the newest sample.
        if matches!(notice, Notice::Missed(_)) {
            return Ok(());
        }
        if self.display == LightDisplay::Json {
            return json::notices(&mut self.out, names, &notice);
        }
        self.clear_line()?;
        self.notes.line(|line| text::notice(line, names, &notice))?;
        match self.display {
            LightDisplay::Terminal { .. } => self.draw(),
            LightDisplay::Json | LightDisplay::Lines => Ok(()),
        }
    }

    /// Turns the mark light off if the mark count is stale. Shows a better verdict that has lasted long enough. Tries
    /// failed LEDs again.
    fn tick(&mut self, now: Instant) -> Result<(), ExitReason> {
        let marks = if self.marks.silence(clock::now()) { None } else { self.states.marks };
        self.show_known(marks, now)?;
        self.switch(now)
    }
}

/// JSON line of class `leds`.
#[derive(Serialize)]
struct LedsJson<'a> {
    class: &'static str,
    sensor: &'a str,
    stamp_ns: u64,
    wall_ns: u64,
    verdict: &'static str,
    marks: Option<usize>,
    green: bool,
    yellow: bool,
    red: bool,
    mark: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    worst: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<&'a str>,
}

impl<'a> LedsJson<'a> {
    fn new(sensor: &'a str, states: &'a LightStates, reason: Option<&'a str>) -> LedsJson<'a> {
        LedsJson {
            class: "leds",
            sensor,
            stamp_ns: clock::now().monotonic_ns,
            wall_ns: clock::wall_ns(),
            verdict: states.verdict.name(),
            marks: states.marks,
            green: states.is_on(Light::Green),
            yellow: states.is_on(Light::Yellow),
            red: states.is_on(Light::Red),
            mark: states.is_on(Light::Mark),
            worst: states.worst.as_deref(),
            reason,
        }
    }
}

/// JSON line of class `led`: an LED failed or works again.
#[derive(Serialize)]
struct LedJson<'a> {
    class: &'static str,
    light: &'static str,
    name: &'a str,
    state: &'static str,
    message: Option<String>,
    hint: Option<String>,
}

/// Moves the cursor to the start of the line, and erases it (ECMA-48).
const CLEAR_LINE: &[u8] = b"\r\x1b[K";

/// A light.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Light {
    /// No object is in any zone.
    Green,
    /// An object is in a zone, but not in the smallest one.
    Yellow,
    /// An object is in the smallest zone, or the verdict is unknown.
    Red,
    /// The sensor detects a reflector mark.
    Mark,
}

impl Light {
    /// All lights, in the order in which all output shows them.
    const ALL: [Light; 4] = [Light::Green, Light::Yellow, Light::Red, Light::Mark];

    /// Returns the light's name in all output and on the command line.
    fn name(self) -> &'static str {
        match self {
            Light::Green => "green",
            Light::Yellow => "yellow",
            Light::Red => "red",
            Light::Mark => "mark",
        }
    }

    /// Returns the light's color code on a terminal (ECMA-48, SGR).
    fn color(self) -> u8 {
        match self {
            Light::Green => 32,
            Light::Yellow => 33,
            Light::Red => 31,
            Light::Mark => 36,
        }
    }
}

/// Known state of a sensor, which determines the lights.
#[derive(Clone, Debug, PartialEq, Eq)]
struct LightStates {
    /// Verdict of the sensor's zones, or the combined verdict of the robot.
    verdict: Verdict,
    /// Number of reflector marks in the last scan; `None` if it is unknown.
    marks: Option<usize>,
    /// Sensor with the worst verdict, which determines a combined verdict; `None` for the verdict of one sensor.
    worst: Option<String>,
}

impl LightStates {
    /// State in which nothing is known of the sensor: the red light is on.
    const UNKNOWN: LightStates = LightStates { verdict: Verdict::Unknown, marks: None, worst: None };

    /// Returns whether `light` is on. For the unknown verdict, the red light is on.
    fn is_on(&self, light: Light) -> bool {
        match light {
            Light::Green => self.verdict == Verdict::Clear,
            Light::Yellow => self.verdict == Verdict::Slow,
            Light::Red => matches!(self.verdict, Verdict::Stop | Verdict::Unknown),
            Light::Mark => self.marks.is_some_and(|marks| marks > 0),
        }
    }

    /// Writes the lights of `sensor` and a possible `reason`. The line is readable with and without `colors`.
    fn line(&self, line: &mut Vec<u8>, sensor: &str, reason: Option<&str>, colors: bool) -> io::Result<()> {
        write!(line, "{sensor}")?;
        for light in Light::ALL {
            let (name, lit) = (light.name(), self.is_on(light));
            let sign = if lit { '●' } else { '○' };
            match (lit, colors) {
                (true, true) => write!(line, "  \x1b[1;{}m{sign} {name}\x1b[0m", light.color())?,
                _ => write!(line, "  {sign} {name}")?,
            }
        }
        write!(line, "  {}", self.verdict.name())?;
        if let Some(worst) = &self.worst {
            write!(line, " {worst}")?;
        }
        match self.marks {
            Some(1) => write!(line, ", 1 mark")?,
            Some(marks) => write!(line, ", {marks} marks")?,
            None => {}
        }
        match reason {
            Some(reason) => write!(line, ", {reason}"),
            None => Ok(()),
        }
    }
}

/// A verdict. A combined verdict has the name of the sensor that determines it.
type SensorVerdict = (Verdict, Option<String>);

/// Worst verdict during the last `hold`, so that the lights do not flicker. A worse verdict is shown at once. A better
/// verdict is shown after it has lasted for `hold`.
struct WorstVerdictHold {
    hold: Duration,
    current: SensorVerdict,
    /// Earlier verdicts that were worse than the current one, each with the time at which it last ended.
    previous: Vec<(SensorVerdict, Instant)>,
}

impl WorstVerdictHold {
    /// Creates a hold. A verdict counts until `hold` has elapsed since its end. The first verdict is unknown.
    fn new(hold: Duration) -> WorstVerdictHold {
        WorstVerdictHold { hold, current: (Verdict::Unknown, None), previous: Vec::new() }
    }

    /// Adds a new verdict at `now`.
    fn take(&mut self, new_verdict: SensorVerdict, now: Instant) {
        let is_worse = |verdict: Verdict| verdict != new_verdict.0 && verdict.worse(new_verdict.0) == verdict;
        self.previous.retain(|((verdict, _), _)| is_worse(*verdict));
        let ended = mem::replace(&mut self.current, new_verdict);
        if ended.0 != self.current.0 && ended.0.worse(self.current.0) == ended.0 {
            self.previous.retain(|((verdict, _), _)| *verdict != ended.0);
            self.previous.push((ended, now));
        }
    }

    /// Returns the verdict to show at `now`.
    fn shown(&mut self, now: Instant) -> &SensorVerdict {
        let hold = self.hold;
        self.previous.retain(|(_, until)| now.saturating_duration_since(*until) < hold);
        let verdicts = self.previous.iter().map(|(verdict, _)| verdict);
        verdicts.fold(
            &self.current,
            |worst, verdict| if worst.0.worse(verdict.0) == verdict.0 { verdict } else { worst },
        )
    }

    /// Returns the next time at which the shown verdict changes even if no new verdict arrives.
    fn changes_at(&self) -> Option<Instant> {
        self.previous.iter().filter_map(|(_, until)| until.checked_add(self.hold)).min()
    }
}

#[cfg(test)]
mod tests {
    use Verdict::{Clear, Slow, Stop, Unknown};

    use super::*;

    fn states(verdict: Verdict, marks: Option<usize>) -> LightStates {
        LightStates { verdict, marks, worst: None }
    }

    #[test]
    fn verdict_lights_one_led_and_marks_light_another() {
        for (verdict, light) in [
            (Verdict::Clear, Light::Green),
            (Verdict::Slow, Light::Yellow),
            (Verdict::Stop, Light::Red),
            (Verdict::Unknown, Light::Red),
        ] {
            for (marks, is_lit) in [(None, false), (Some(0), false), (Some(1), true), (Some(12), true)] {
                let states = states(verdict, marks);
                for one in [Light::Green, Light::Yellow, Light::Red] {
                    assert_eq!(states.is_on(one), one == light, "{states:?}");
                }
                assert_eq!(states.is_on(Light::Mark), is_lit);
            }
        }
        assert!(LightStates::UNKNOWN.is_on(Light::Red));
    }

    #[test]
    fn line_shows_lights_verdict_and_reason() {
        let text = |states: &LightStates, colors| {
            let mut line = Vec::new();
            states.line(&mut line, "front", None, colors).unwrap();
            String::from_utf8(line).unwrap()
        };
        let stop = LightStates { worst: Some("rear".into()), ..states(Verdict::Stop, None) };
        assert_eq!(text(&stop, false), "front  ○ green  ○ yellow  ● red  ○ mark  stop rear");
        let clear = states(Verdict::Clear, Some(1));
        assert_eq!(text(&clear, false), "front  ● green  ○ yellow  ○ red  ● mark  clear, 1 mark");
        assert_eq!(
            text(&clear, true),
            "front  \x1b[1;32m● green\x1b[0m  ○ yellow  ○ red  \x1b[1;36m● mark\x1b[0m  clear, 1 mark"
        );
        assert!(text(&states(Verdict::Slow, Some(0)), false).ends_with("  slow, 0 marks"));
        let mut line = Vec::new();
        stop.line(&mut line, "robot", Some("41 % lost on the line"), false).unwrap();
        assert!(line.ends_with(b"  stop rear, 41 % lost on the line"));
    }

    const HOLD_MS: u64 = 300;

    /// Returns the shown verdict after each step. A step is a time in ms, with a new verdict or without one.
    fn shown_verdicts(steps: &[(u64, Option<Verdict>)]) -> Vec<Verdict> {
        let (mut hold, start) = (WorstVerdictHold::new(Duration::from_millis(HOLD_MS)), Instant::now());
        let at = |ms| start + Duration::from_millis(ms);
        let step = |&(ms, verdict): &(u64, Option<Verdict>)| {
            if let Some(verdict) = verdict {
                hold.take((verdict, None), at(ms));
            }
            hold.shown(at(ms)).0
        };
        steps.iter().map(step).collect()
    }

    #[test]
    fn worse_verdict_shows_at_once_better_after_the_hold() {
        let steps = [(0, Some(Clear)), (299, None), (300, None), (400, Some(Slow)), (401, Some(Stop))];
        assert_eq!(shown_verdicts(&steps), [Unknown, Unknown, Clear, Slow, Stop]);
        let steps = [(0, Some(Stop)), (100, Some(Clear)), (399, Some(Clear)), (400, None)];
        assert_eq!(shown_verdicts(&steps), [Stop, Stop, Stop, Clear]);
    }

    #[test]
    fn flickering_verdict_stays_at_the_worst() {
        let steps: Vec<_> = (0..20).map(|n| (n * 200, Some(if n % 2 == 0 { Stop } else { Clear }))).collect();
        assert!(shown_verdicts(&steps).iter().all(|verdict| *verdict == Stop));
    }

    #[test]
    fn verdict_improves_step_by_step() {
        let steps =
            [(0, Some(Stop)), (10, Some(Slow)), (110, Some(Clear)), (309, None), (310, None), (409, None)];
        assert_eq!(shown_verdicts(&steps), [Stop, Stop, Stop, Stop, Slow, Slow]);
        assert_eq!(shown_verdicts(&[&steps[..], &[(410, None)]].concat()).last(), Some(&Clear));
    }

    #[test]
    fn held_verdict_keeps_its_sensor_until_the_hold_ends() {
        let (mut hold, now) = (WorstVerdictHold::new(Duration::from_millis(HOLD_MS)), Instant::now());
        hold.take((Stop, Some("rear".into())), now);
        assert_eq!(hold.changes_at(), None);
        hold.take((Clear, Some("front".into())), now);
        assert_eq!(hold.shown(now), &(Stop, Some("rear".into())));
        let end = now + Duration::from_millis(HOLD_MS);
        assert_eq!((hold.changes_at(), hold.shown(end).clone()), (Some(end), (Clear, Some("front".into()))));
        assert_eq!(hold.changes_at(), None);
    }

    #[test]
    fn without_a_hold_every_verdict_is_shown_at_once() {
        let (mut hold, now) = (WorstVerdictHold::new(Duration::ZERO), Instant::now());
        for verdict in [Clear, Stop, Slow, Clear, Unknown, Clear] {
            hold.take((verdict, None), now);
            assert_eq!(hold.shown(now).0, verdict);
        }
    }
}
