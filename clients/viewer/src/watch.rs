//! `scanhub watch`: what the sensors see, live, as a picture in the terminal. It sleeps until there is new data,
//! limits the frame rate so that a slow line can carry it, and restores the terminal however it ends.

#[cfg(test)]
mod asked;
mod counters;
mod draw;
#[cfg(test)]
mod golden;
mod hub_requests;
mod keys;
mod map;
mod screen;
mod view;

use std::io::Write;
use std::rc::Rc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use scanhub_client::clock;
use scanhub_client::streams::Sample;
use scanhub_schema::{Failure, Kind, Topic, Verb, check_followed, is_remote};
use scanhub_shm::Domain;

use crate::picture;
use scanhub_verbs::follow::{Bounds, Notice, ReceiveStats, Sink, follow};
use scanhub_verbs::names::{TopicName, as_word};
use scanhub_verbs::output::{End, quiet};

use crate::scene::Scene;
use crate::work::Work;
use hub_requests::HubRequests;
use keys::Key;
use screen::{News, Screen};
use view::{View, Wish};

/// What `watch` is asked for.
#[derive(Clone, Debug)]
pub struct WatchOptions {
    /// The sensors; none: all of the hub.
    pub sensors: Vec<String>,
    /// Colours may be used.
    pub colours: bool,
    /// What stands below the picture beside the keys; empty: nothing.
    pub note: String,
    /// When it ends by itself; a person ends it at any time.
    pub bounds: Bounds,
    /// Where the domain may be, see [`Domain::candidates`].
    pub places: Vec<Domain>,
}

/// Shows the picture on the terminal that `out` writes to, until a person ends it, the bounds are reached or `stop` is set.
///
/// [`Kind::Failed`] if there is no terminal that can be taken over, [`Kind::Interrupted`] if Ctrl-C ends a bounded run;
/// else as [`echo`](crate::echo()).
pub fn watch(options: &WatchOptions, out: &mut dyn Write, stop: &AtomicBool) -> Result<(), Failure> {
    options.sensors.iter().try_for_each(|sensor| as_word(check_followed(sensor)))?;
    let (names, topics) = picture::followed(&options.sensors, &picture::TOPICS, &options.places);
    let end = Screen::new(out).and_then(|screen| {
        let mut watcher = Watcher {
            options,
            scene: Scene::default(),
            held: None,
            view: View { note: options.note.clone(), ..View::new(options.colours) },
            screen,
            requests: HubRequests::default(),
            work: Work::default(),
            changed: true,
            draw_at: Instant::now(),
            news_until: None,
        };
        follow(&names, &topics, &options.places, &options.bounds, stop, &mut watcher)
    });
    quiet(end)
}

struct Watcher<'a> {
    options: &'a WatchOptions,
    scene: Scene,
    /// The scene whose picture is shown while that is held; the verdict and the sensors' lines go on.
    held: Option<Scene>,
    view: View,
    screen: Screen<'a>,
    requests: HubRequests,
    work: Work,
    /// The screen does not show what is known.
    changed: bool,
    /// No frame before.
    draw_at: Instant,
    news_until: Option<Instant>,
}

impl Watcher<'_> {
    fn tell(&mut self, news: String, now: Instant) {
        self.view.news = news;
        self.news_until = Some(now + READING_TIME);
        self.changed = true;
    }

    /// Does what was typed; a resized window is redrawn.
    fn listen(&mut self, now: Instant) -> Result<(), End> {
        while let Some(news) = self.screen.news()? {
            self.changed = true;
            // A person who types waits for the answer; a mouse says more than can be drawn.
            if !matches!(news, News::Key(Key::Point(..))) {
                self.draw_at = now;
            }
            let News::Key(key) = news else { continue };
            let wish = self.view.key(key, &self.scene);
            if !self.view.lines {
                self.scene.forget_lines();
            }
            match (self.view.paused, &self.held) {
                (true, None) => self.held = Some(self.scene.clone()),
                (false, Some(_)) => self.held = None,
                _ => {}
            }
            match wish {
                Some(Wish::Interrupt) if self.options.bounds.bounded() => {
                    return Err(Failure::new(Kind::Interrupted, "interrupted before it was done", "").into());
                }
                Some(Wish::Quit | Wish::Interrupt) => return Err(End::ReaderGone),
                Some(Wish::Reset) => self.order(Verb::Reset, now),
                Some(Wish::Freeze) => self.order(Verb::Freeze, now),
                None => {}
            }
        }
        Ok(())
    }

    /// Asks the hub about the background of the sensors that are shown; where all of them are frozen already they thaw.
    fn order(&mut self, verb: Verb, now: Instant) {
        let shown = self.view.shown(&self.scene);
        let own: Vec<_> = shown.into_iter().filter(|(_, sensor)| !is_remote(&sensor.name)).collect();
        let is_frozen = !own.is_empty() && own.iter().all(|(_, sensor)| sensor.is_frozen());
        let sensors: Vec<_> = own.into_iter().map(|(_, sensor)| sensor.name.clone()).collect();
        if sensors.is_empty() {
            return self.tell("no sensor of this machine is shown".into(), now);
        }
        let verb = if verb == Verb::Freeze && is_frozen { Verb::Thaw } else { verb };
        if !self.requests.give(&self.options.places, sensors, verb) {
            self.tell("the hub still works on the last request".into(), now);
        }
    }

    fn draw(&mut self, now: Instant) -> Result<(), End> {
        let (scene, held, view) = (&self.scene, self.held.as_ref(), &mut self.view);
        let bytes = self.screen.draw(|frame| {
            view.map = draw::place_of_map(frame.area(), scene);
            view.fit(held.unwrap_or(scene));
            draw::draw(frame, scene, held, view);
        })?;
        self.changed = false;
        self.draw_at = now + FRAME.max(Duration::from_secs_f64(bytes as f64 / BYTES_PER_SECOND));
        Ok(())
    }
}

impl Sink for Watcher<'_> {
    fn begin(&mut self, name: &TopicName) {
        picture::begin(&mut self.scene, name);
    }

    fn sample(&mut self, name: &TopicName, sample: &Sample) -> Result<(), End> {
        picture::take(&mut self.scene, name, sample);
        self.changed = true;
        Ok(())
    }

    fn notice(&mut self, names: &[Rc<TopicName>], notice: Notice) -> Result<(), End> {
        picture::note(&mut self.scene, names, &notice);
        self.changed = true;
        if let Notice::NoHub(Failure { message, hint, .. }) = notice {
            self.tell(format!("{message}: {hint}"), Instant::now());
        }
        Ok(())
    }

    fn tick(&mut self, now: Instant) -> Result<(), End> {
        self.listen(now)?;
        if let Some(done) = self.requests.done() {
            for (sensor, model) in done.models {
                self.scene.sensor(&sensor).background = Some(model);
            }
            self.tell(done.news, now);
        }
        if self.news_until.is_some_and(|until| now >= until) {
            self.news_until = None;
            self.view.news.clear();
            self.changed = true;
        }
        self.changed |= self.scene.age(clock::now_ns());
        if self.scene.hub_pid != 0 {
            let percent = self.work.look(self.scene.hub_pid, now);
            self.changed |= percent != self.scene.hub_percent;
            self.scene.hub_percent = percent;
        }
        if self.changed && now >= self.draw_at {
            self.draw(now)?;
        }
        Ok(())
    }

    fn wants(&self, topic: Topic) -> bool {
        topic != Topic::Lines || self.view.lines
    }

    /// What is followed already is shown.
    fn short(&mut self, name: &TopicName, failure: Failure) -> Result<(), End> {
        self.tell(format!("{name} is not shown: {}; {}", failure.message, failure.hint), Instant::now());
        Ok(())
    }

    fn wake_at(&self) -> Option<Instant> {
        self.changed.then_some(self.draw_at)
    }

    fn summary(&mut self, _: &TopicName, _: &ReceiveStats) -> Result<(), End> {
        Ok(())
    }
}

/// Between two frames: what a scan shows is on the screen within 50 ms.
const FRAME: Duration = Duration::from_millis(45);
/// A line that carries no more shows fewer frames.
const BYTES_PER_SECOND: f64 = 80_000.0;
/// How long news stand where the keys are told.
const READING_TIME: Duration = Duration::from_secs(4);
