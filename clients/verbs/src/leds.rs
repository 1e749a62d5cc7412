//! `scanhub leds`: the zone verdict and the mark count of a sensor as lights, in the terminal and on light-emitting
//! diodes of the machine. The lights never show a better state than is known: the verb starts and ends with the stop
//! light, and shows it when the hub is silent.

mod device;
mod hold;
mod lamps;

use std::io::Write;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use scanhub_client::clock;
use scanhub_client::streams::{Freshness, Sample};
use scanhub_schema::{Failure, Kind, ROBOT, Status, Topic, Verdict, check_followed};
use scanhub_shm::Domain;
use serde::Serialize;

use crate::follow::{Bounds, Event, Following, Notice};
use crate::names::{TopicName, as_word};
use crate::output::{End, Output, quiet};
use crate::{json, text};
use device::{Device, News};
use hold::Hold;
use lamps::{Lamps, Light};

/// What `leds` is asked for.
#[derive(Clone, Debug)]
pub struct LedsOptions {
    /// The sensor, or `robot` for the verdict over all of them.
    pub sensor: String,
    /// `LIGHT=NAME`: the light-emitting diode that shows a light; one light may have several, not one diode several lights.
    pub leds: Vec<String>,
    /// Where they are: `/sys/class/leds`.
    pub led_root: PathBuf,
    /// How lights are shown in the terminal.
    pub look: LedsLook,
    /// Early warnings count too.
    pub early: bool,
    /// How long a better verdict has to stand until it is shown; a worse one is at once.
    pub hold: Duration,
    /// When it ends by itself.
    pub bounds: Bounds,
    /// Where the domain may be, see [`Domain::candidates`].
    pub places: Vec<Domain>,
}

/// How lights are shown in the terminal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LedsLook {
    /// A line for each change.
    Lines,
    /// An object for each change.
    Json,
    /// One line that is drawn over itself.
    Terminal {
        /// Lit lights have their colour.
        colours: bool,
    },
}

/// Shows the lights on `out` and on the diodes until the bounds are reached or `stop` is set; what is no light goes to
/// `notes` (stderr) if `out` is not JSON. However it ends, the stop light is on then: nobody watches any more.
///
/// [`Kind::Configuration`] if a diode is not there or stands for no light; [`Kind::Failed`] if one may not be
/// switched; else as [`echo`](crate::echo()). An LED that fails later is reported and tried again; the others
/// continue.
pub fn leds(
    options: &LedsOptions,
    out: &mut dyn Write,
    notes: &mut dyn Write,
    stop: &AtomicBool,
) -> Result<(), Failure> {
    let LedsOptions { sensor, leds, .. } = options;
    let topics = if sensor == ROBOT { &[Topic::Zones][..] } else { &[Topic::Zones, Topic::Marks] };
    if sensor != ROBOT {
        as_word(check_followed(sensor))?;
    }
    let names: Vec<_> = topics.iter().map(|&topic| TopicName { sensor: sensor.clone(), topic }).collect();
    let wanted = wanted(sensor, leds)?;
    let mut board = Board {
        sensor,
        look: options.look,
        lamps: Lamps::UNKNOWN,
        verdict: Hold::new(options.hold),
        marks: Freshness::new(clock::now()),
        losses: Vec::new(),
        devices: Vec::new(),
        out: Output::new(out),
        notes: Output::new(notes),
    };
    let began = board.take(&options.led_root, &wanted).and_then(|()| board.show(Lamps::UNKNOWN, true));
    let LedsOptions { places, bounds, .. } = options;
    let mut following = Following::new(&names, &[], places, bounds, stop).with_lines();
    if options.early {
        following = following.with_early();
    }
    let end = began.and_then(|()| board.run(&mut following));
    quiet(end.and(board.leave()))
}

/// Light and name in each of `leds`. A name stands once: a diode that showed two lights would not tell which.
fn wanted<'a>(sensor: &str, leds: &'a [String]) -> Result<Vec<(Light, &'a str)>, Failure> {
    let mut wanted: Vec<(Light, &str)> = Vec::new();
    for led in leds {
        let refuse =
            |hint: &str| Err(Failure::new(Kind::Configuration, format!("--led {led} cannot be shown"), hint));
        let Some((light, name)) = led.split_once('=') else { return refuse(LED_FORM) };
        let Some(light) = Light::ALL.into_iter().find(|it| it.name() == light) else {
            return refuse(&format!("no light {light:?}: {LED_FORM}"));
        };
        if light == Light::Mark && sensor == ROBOT {
            return refuse("marks belong to one sensor: name the sensor");
        }
        if let Some((other, _)) = wanted.iter().find(|(_, taken)| *taken == name) {
            return refuse(&format!("{name} already shows {}: each light has its own LEDs", other.name()));
        }
        wanted.push((light, name));
    }
    Ok(wanted)
}

const LED_FORM: &str = "green=NAME, yellow=NAME, red=NAME or mark=NAME, with a NAME from /sys/class/leds";

/// The lights as they are.
struct Board<'a> {
    sensor: &'a str,
    look: LedsLook,
    lamps: Lamps,
    /// What was said lately.
    verdict: Hold,
    /// Until when the marks may be believed, whatever became of the zones.
    marks: Freshness,
    /// What each sensor's line takes away, of those that lose something.
    losses: Vec<(String, String)>,
    devices: Vec<(Light, String, Device)>,
    out: Output<'a>,
    notes: Output<'a>,
}

impl Board<'_> {
    /// Takes the diodes below `root`.
    fn take(&mut self, root: &Path, wanted: &[(Light, &str)]) -> Result<(), End> {
        for &(light, name) in wanted {
            let (device, trigger) = Device::open(root, name)?;
            self.devices.push((light, name.to_owned(), device));
            if let Some(trigger) = trigger {
                self.note(&format!("{name} was lit by {trigger}, now it shows {}", light.name()))?;
            }
        }
        Ok(())
    }

    /// Shows the verdict that holds, and so many marks.
    fn show_known(&mut self, marks: Option<usize>, now: Instant) -> Result<(), End> {
        let (verdict, worst) = self.verdict.shown(now).clone();
        self.show(Lamps { verdict, marks, worst }, false)
    }

    /// Shows `lamps` if they are others than those that are shown, or if they `must` be.
    fn show(&mut self, lamps: Lamps, must: bool) -> Result<(), End> {
        if self.lamps == lamps && !must {
            return Ok(());
        }
        self.lamps = lamps;
        // First what acts, then what tells.
        self.switch(Instant::now())?;
        self.draw()
    }

    fn switch(&mut self, now: Instant) -> Result<(), End> {
        let mut told = Vec::new();
        for (light, name, device) in &mut self.devices {
            if let Some(news) = device.show(self.lamps.lit(*light), now) {
                told.push((*light, name.clone(), news));
            }
        }
        told.into_iter().try_for_each(|(light, name, news)| self.tell(light, &name, news))
    }

    /// Says what became of a diode.
    fn tell(&mut self, light: Light, name: &str, news: News) -> Result<(), End> {
        let (state, failure) = match news {
            News::Failed(failure) => ("failed", Some(failure)),
            News::Back => ("back", None),
        };
        if self.look == LedsLook::Json {
            let (message, hint) = failure.map(|it| (it.message, it.hint)).unzip();
            return self.out.json(&Led { class: "led", light: light.name(), name, state, message, hint });
        }
        self.note(&failure.map_or(format!("{name} is back"), |failure| failure.to_string()))
    }

    /// A line beside the lights, which are drawn again below it.
    fn note(&mut self, what: &str) -> Result<(), End> {
        self.wipe()?;
        self.notes.line(|line| write!(line, "{what}"))
    }

    fn draw(&mut self) -> Result<(), End> {
        let reason = self.reason();
        let Board { sensor, lamps, .. } = self;
        let (sensor, reason) = (*sensor, reason.as_deref());
        match self.look {
            LedsLook::Json => self.out.json(&Line::new(sensor, lamps, reason)),
            LedsLook::Lines => self.out.line(|line| lamps.line(line, sensor, reason, false)),
            LedsLook::Terminal { colours } => {
                // A line that wraps would not be drawn over: it is cut.
                let mut line = [WIPE, b"\x1b[?7l"].concat();
                lamps.line(&mut line, sensor, reason, colours)?;
                line.extend(b"\x1b[?7h");
                self.out.raw(&line)
            }
        }
    }

    /// What may be behind the verdict: what the line of the sensor takes away whose verdict it is, else that of any.
    fn reason(&self) -> Option<String> {
        let whose = self.lamps.worst.as_deref();
        let of_worst = self.losses.iter().find(|(sensor, _)| Some(sensor.as_str()) == whose);
        let (sensor, loss) = of_worst.or(self.losses.first())?;
        let is_plain = sensor == self.sensor || Some(sensor.as_str()) == whose;
        Some(if is_plain { loss.clone() } else { format!("{sensor}: {loss}") })
    }

    fn wipe(&mut self) -> Result<(), End> {
        match self.look {
            LedsLook::Terminal { .. } => self.out.raw(WIPE),
            LedsLook::Json | LedsLook::Lines => Ok(()),
        }
    }

    /// The stop light stays, because nobody watches any more.
    fn leave(&mut self) -> Result<(), End> {
        self.show(Lamps::UNKNOWN, false)?;
        // Also if it was lost before it was shown.
        self.switch(Instant::now())?;
        match self.look {
            LedsLook::Terminal { .. } => self.out.raw(b"\n"),
            LedsLook::Json | LedsLook::Lines => Ok(()),
        }
    }
}

impl Board<'_> {
    fn run(&mut self, following: &mut Following<'_>) -> Result<(), End> {
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

    fn sample(&mut self, sample: &Sample) -> Result<(), End> {
        let now = Instant::now();
        let mut marks = self.lamps.marks;
        match sample {
            Sample::Zones(heard) => self.verdict.take((heard.zones.verdict(), None), now),
            Sample::Robot(heard) => {
                let worst = heard.robot.worst().map(str::to_owned);
                self.verdict.take((heard.robot.verdict(), worst), now);
            }
            Sample::Marks(sample) => {
                // A number of marks ages as a verdict does of which something is known.
                let fresh = self.marks.heard(sample.header(), Verdict::Clear, clock::now());
                marks = (fresh && sample.is_available()).then(|| sample.marks().len());
            }
            _ => {}
        }
        self.show_known(marks, now)
    }

    /// Reported when a line starts or stops losing data; the changing amount is not.
    fn line(&mut self, sensor: &str, status: &Status) -> Result<(), End> {
        let known = self.losses.iter().position(|(name, _)| name == sensor);
        let loss = status.line_loss();
        let is_news = known.is_some() != loss.is_some();
        match (known, loss) {
            (Some(at), Some(loss)) => self.losses[at].1 = loss,
            (Some(at), None) => drop(self.losses.remove(at)),
            (None, Some(loss)) => self.losses.push((sensor.to_owned(), loss)),
            (None, None) => {}
        }
        if is_news { self.draw() } else { Ok(()) }
    }

    fn notice(&mut self, names: &[Rc<TopicName>], notice: Notice) -> Result<(), End> {
        // Not worth a word: what counts is what stands now.
        if matches!(notice, Notice::Missed(_)) {
            return Ok(());
        }
        if self.look == LedsLook::Json {
            return json::notices(&mut self.out, names, &notice);
        }
        self.wipe()?;
        self.notes.line(|line| text::notice(line, names, &notice))?;
        match self.look {
            LedsLook::Terminal { .. } => self.draw(),
            LedsLook::Json | LedsLook::Lines => Ok(()),
        }
    }

    /// Marks that became too old go out, a verdict that has stood is shown, and diodes that failed are tried again.
    fn tick(&mut self, now: Instant) -> Result<(), End> {
        let marks = if self.marks.silence(clock::now()) { None } else { self.lamps.marks };
        self.show_known(marks, now)?;
        self.switch(now)
    }
}

/// Class `leds`.
#[derive(Serialize)]
struct Line<'a> {
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

impl<'a> Line<'a> {
    fn new(sensor: &'a str, lamps: &'a Lamps, reason: Option<&'a str>) -> Line<'a> {
        Line {
            class: "leds",
            sensor,
            stamp_ns: clock::now().monotonic_ns,
            wall_ns: clock::wall_ns(),
            verdict: lamps.verdict.name(),
            marks: lamps.marks,
            green: lamps.lit(Light::Green),
            yellow: lamps.lit(Light::Yellow),
            red: lamps.lit(Light::Red),
            mark: lamps.lit(Light::Mark),
            worst: lamps.worst.as_deref(),
            reason,
        }
    }
}

/// Class `led`: a diode that failed, or is back.
#[derive(Serialize)]
struct Led<'a> {
    class: &'static str,
    light: &'static str,
    name: &'a str,
    state: &'static str,
    message: Option<String>,
    hint: Option<String>,
}

/// To the line's begin, and nothing on it (ECMA-48).
const WIPE: &[u8] = b"\r\x1b[K";
