//! `scanhub watch`: the live picture in the terminal. The verb sleeps until new data arrives, limits the frame rate for
//! slow terminals, and always restores the terminal.

mod draw;
mod map;
mod terminal;
mod view;

use std::io::{IsTerminal, Write, stdout};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use clap::Args;
use scanhub_client::request;
use scanhub_schema::{Background, Failure, Kind, Request, Topic, Verb, check_any_sensor, is_remote};
use scanhub_shm::Domain;
use scanhub_verbs::RunLimits;
use scanhub_verbs::context::Context;
use scanhub_verbs::follow::{Event, Notice, TopicRun};
use scanhub_verbs::names::as_argument;
use scanhub_verbs::output::{ExitReason, colors, verb_result};

use crate::live_scene::{LiveScene, TOPICS, topics_to_follow};
use crate::scene::Scene;
use terminal::{Input, Key, Terminal};
use view::{View, ViewCommand};

/// Show the live picture in the terminal: scans, marks, zones and the verdict
#[derive(Args, Clone, Debug, Default)]
#[command(after_help = AFTER_HELP)]
pub struct WatchArgs {
    /// Sensors to show [default: all]
    #[arg(value_name = "SENSOR")]
    sensors: Vec<String>,
    #[command(flatten)]
    limits: RunLimits,
}

const AFTER_HELP: &str = "\
Examples:
  scanhub watch
  scanhub watch front

Keys: q quits, ? lists the other keys. NO_COLOR=1 shows signs instead of colors. From another machine: ssh -t robot scanhub watch.";

/// Minimum interval between frames. With this interval, a scan is on the screen within 50 ms.
const FRAME_INTERVAL: Duration = Duration::from_millis(45);
/// Maximum number of bytes of frames per second. Large frames are drawn less often.
const BYTES_PER_SECOND: f64 = 80_000.0;
/// Time for which a message is shown instead of the keys.
const MESSAGE_TIME: Duration = Duration::from_secs(4);

impl WatchArgs {
    /// Shows the picture of the sensors in the terminal, until the user quits, the limits are reached or a signal stops
    /// it.
    ///
    /// # Errors
    ///
    /// - [`Kind::Usage`] with `--json`, without a terminal, or if a sensor's name is not valid.
    /// - [`Kind::Failed`] if the terminal cannot be used.
    /// - [`Kind::Interrupted`] if Ctrl-C ends a bounded run.
    /// - [`Kind::NoHub`], [`Kind::NoTopic`] and [`Kind::Timeout`] in the same cases as `scanhub echo`.
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        // Every signal that ends the run must restore the terminal.
        let (locations, stop) = (context.domain.locations()?, context.signals.any_stop()?);
        let json = context.json;
        if json || !can_show_pictures() {
            let sensor = self.sensors.first().map_or("robot/zones".to_owned(), |name| format!("{name}/scan"));
            let hint = format!("lines for files and programs: scanhub echo {sensor}, with --json as objects");
            let what = if json { "`watch` has no JSON output" } else { "the picture needs a terminal" };
            return Err(Failure::new(Kind::Usage, what, hint));
        }
        self.show("", &locations, &mut context.out, &stop)
    }

    /// Shows the picture as [`run`](Self::run) does, with a `note` next to the keys, and without checking for a
    /// terminal.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`run`](Self::run).
    pub fn show(
        &self,
        note: &str,
        locations: &[Domain],
        out: &mut dyn Write,
        stop: &AtomicBool,
    ) -> Result<(), Failure> {
        self.sensors.iter().try_for_each(|sensor| as_argument(check_any_sensor(sensor)))?;
        let (names, topics) = topics_to_follow(&self.sensors, &TOPICS, locations);
        let end = Terminal::new(out).and_then(|terminal| {
            let mut watcher = Watcher {
                locations,
                is_bounded: self.limits.is_bounded(),
                live: LiveScene::default(),
                held_scene: None,
                view: View { note: note.to_owned(), ..View::new(colors()) },
                terminal,
                request: BackgroundRequest::default(),
                changed: true,
                draw_at: Instant::now(),
                message_until: None,
            };
            let following = TopicRun::new(&names, &topics, locations, &self.limits, stop);
            watcher.follow(&mut following.tolerating_shortage())
        });
        verb_result(end)
    }
}

/// Returns whether stdout is a terminal with cursor control.
pub fn can_show_pictures() -> bool {
    stdout().is_terminal() && std::env::var_os("TERM").is_none_or(|term| term != "dumb")
}

struct Watcher<'a> {
    /// Locations where the domain may be.
    locations: &'a [Domain],
    /// Whether the arguments limit the run. Ctrl-C before the limit is then a failure.
    is_bounded: bool,
    live: LiveScene,
    /// Scene of the frozen picture; `None` if the picture is live. The verdict and the lines of the sensors stay live.
    held_scene: Option<Scene>,
    view: View,
    terminal: Terminal<'a>,
    request: BackgroundRequest,
    /// Whether the screen is out of date.
    changed: bool,
    /// Earliest time of the next frame.
    draw_at: Instant,
    message_until: Option<Instant>,
}

impl Watcher<'_> {
    /// Shows a message instead of the keys.
    fn show_message(&mut self, message: String, now: Instant) {
        self.view.message = message;
        self.message_until = Some(now + MESSAGE_TIME);
        self.changed = true;
    }

    /// Handles keys, the mouse, and a new size of the terminal.
    fn handle_input(&mut self, now: Instant) -> Result<(), ExitReason> {
        while let Some(input) = self.terminal.input()? {
            self.changed = true;
            // Respond to keys at once, but not to a mouse, which sends more events than can be drawn.
            if !matches!(input, Input::Key(Key::Point(..))) {
                self.draw_at = now;
            }
            let Input::Key(key) = input else { continue };
            let command = self.view.key(key, &self.live.scene);
            if !self.view.lines {
                self.live.scene.delete_lines();
            }
            match (self.view.paused, &self.held_scene) {
                (true, None) => self.held_scene = Some(self.live.scene.clone()),
                (false, Some(_)) => self.held_scene = None,
                _ => {}
            }
            match command {
                Some(ViewCommand::Interrupt) if self.is_bounded => {
                    return Err(Failure::new(Kind::Interrupted, "interrupted before the end", "").into());
                }
                Some(ViewCommand::Quit | ViewCommand::Interrupt) => return Err(ExitReason::ReaderClosed),
                Some(ViewCommand::Reset) => self.request(Verb::Reset, now),
                Some(ViewCommand::Freeze) => self.request(Verb::Freeze, now),
                None => {}
            }
        }
        Ok(())
    }

    /// Sends the request `verb` for the backgrounds of the shown sensors. If all these backgrounds are frozen, a freeze
    /// becomes a thaw.
    fn request(&mut self, verb: Verb, now: Instant) {
        let shown = self.view.shown(&self.live.scene);
        let own: Vec<_> = shown.into_iter().filter(|(_, sensor)| !is_remote(&sensor.name)).collect();
        let is_frozen = !own.is_empty() && own.iter().all(|(_, sensor)| sensor.is_frozen());
        let sensors: Vec<_> = own.into_iter().map(|(_, sensor)| sensor.name.clone()).collect();
        if sensors.is_empty() {
            return self.show_message("no sensor of this machine is shown".into(), now);
        }
        let verb = if verb == Verb::Freeze && is_frozen { Verb::Thaw } else { verb };
        if !self.request.start(self.locations, sensors, verb) {
            self.show_message("the hub still works on the last request".into(), now);
        }
    }

    fn draw(&mut self, now: Instant) -> Result<(), ExitReason> {
        let (scene, held, view) = (&self.live.scene, self.held_scene.as_ref(), &mut self.view);
        let bytes = self.terminal.draw(|frame| {
            view.map = draw::map_area(frame.area(), scene);
            view.fit(held.unwrap_or(scene));
            draw::draw(frame, scene, held, view);
        })?;
        self.changed = false;
        self.draw_at = now + FRAME_INTERVAL.max(Duration::from_secs_f64(bytes as f64 / BYTES_PER_SECOND));
        Ok(())
    }
}

impl Watcher<'_> {
    fn follow(&mut self, following: &mut TopicRun<'_>) -> Result<(), ExitReason> {
        loop {
            following.set_subscribed(Topic::Lines, self.view.lines);
            let Some(event) = following.next(self.changed.then_some(self.draw_at))? else { return Ok(()) };
            match event {
                Event::Added(name) => self.live.begin(&name),
                Event::Sample(name, sample, _) => {
                    self.live.take(&name, &sample);
                    self.changed = true;
                }
                Event::Notice(names, notice) => {
                    self.live.take_notice(&names, &notice);
                    self.changed = true;
                    if let Notice::NoHub(Failure { message, hint, .. }) = notice {
                        self.show_message(format!("{message}: {hint}"), Instant::now());
                    }
                }
                // Keep the topics that the run has already subscribed to.
                Event::ResourceExhausted(name, Failure { message, hint, .. }) => {
                    self.show_message(format!("{name} is not shown: {message}; {hint}"), Instant::now());
                }
                Event::Tick(now) => {
                    if following.is_caught_up() {
                        self.live.expire_joins();
                    }
                    self.tick(now)?;
                }
                Event::Subscribed(_) | Event::Line(..) => {}
            }
        }
    }

    fn tick(&mut self, now: Instant) -> Result<(), ExitReason> {
        self.handle_input(now)?;
        if let Some(outcome) = self.request.outcome() {
            for (sensor, model) in outcome.models {
                self.live.scene.sensor(&sensor).background = Some(model);
            }
            self.show_message(outcome.message, now);
        }
        if self.message_until.is_some_and(|until| now >= until) {
            self.message_until = None;
            self.view.message.clear();
            self.changed = true;
        }
        self.changed |= self.live.expire();
        self.changed |= self.live.measure_hub(now);
        if self.changed && now >= self.draw_at {
            self.draw(now)?;
        }
        Ok(())
    }
}

/// Request to the hub to reset, freeze or thaw backgrounds. A request runs in its own thread, so that a slow hub does
/// not delay the picture. At most one request runs at a time.
#[derive(Default)]
struct BackgroundRequest {
    running: Option<JoinHandle<RequestOutcome>>,
    stop: Arc<AtomicBool>,
}

struct RequestOutcome {
    /// Text for the user.
    message: String,
    /// Sensors with their backgrounds after the request.
    models: Vec<(String, Box<Background>)>,
}

impl BackgroundRequest {
    /// Sends `verb` to the hub for each of `sensors`. Returns false if the last request is still running.
    fn start(&mut self, locations: &[Domain], sensors: Vec<String>, verb: Verb) -> bool {
        if self.running.is_some() {
            return false;
        }
        let (locations, stop) = (locations.to_vec(), self.stop.clone());
        self.running = Some(std::thread::spawn(move || send_request(&locations, &sensors, verb, &stop)));
        true
    }

    /// Returns the outcome once the request has ended. Later calls return `None`.
    fn outcome(&mut self) -> Option<RequestOutcome> {
        self.running.take_if(|running| running.is_finished())?.join().ok()
    }
}

impl Drop for BackgroundRequest {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        // Wait for the thread, because it occupies a slot of the domain until it ends.
        let _ = self.running.take().map(JoinHandle::join);
    }
}

fn send_request(locations: &[Domain], sensors: &[String], verb: Verb, stop: &AtomicBool) -> RequestOutcome {
    let mut models = Vec::new();
    let mut send = |sensor: &String| -> Result<(), Failure> {
        request(locations, &Request::new(sensor, verb), stop)?;
        let shown = request(locations, &Request::new(sensor, Verb::Show), stop)?;
        models.extend(shown.map(|shown| (sensor.clone(), shown.model)));
        Ok(())
    };
    let outcome = match verb {
        Verb::Reset => "is learned again",
        Verb::Freeze => "is frozen",
        Verb::Thaw => "continues learning",
        other => other.name(),
    };
    let message = match sensors.iter().try_for_each(&mut send) {
        Ok(()) => format!("{}: background {outcome}", sensors.join(", ")),
        Err(failure) => failure.to_string(),
    };
    RequestOutcome { message, models }
}

#[cfg(test)]
mod tests;
