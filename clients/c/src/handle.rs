//! A subscription as C sees it: of any topic, with a sample that a wait found and nobody took yet, and those that are lent.

use std::ffi::c_int;
use std::os::fd::AsRawFd;
use std::ptr;
use std::time::{Duration, Instant};

use scanhub_client::{Domain, Heard, Payload, Received, RobotFollower, Subscription, Wait, ZonesFollower};
use scanhub_schema::{Failure, Header, Topic, limits};

use crate::boundary::Lent;
use crate::call_error::CallError;
use crate::robot::Told;

/// An open subscription.
pub(crate) struct Handle {
    // Before the source: they are given back to it.
    lent: [Option<(u64, Held)>; LENT],
    found: Option<Held>,
    next: u64,
    source: Source,
}

/// Samples that may be lent at a time, as many as the hub has in store for each consumer.
const LENT: usize = limits::BORROWED;

/// Zones are followed with an eye on their age, all else as it comes.
macro_rules! follower {
    (Zones $payload:tt) => {
        ZonesFollower
    };
    ($topic:ident $payload:tt) => {
        Subscription<scanhub_schema::payload_type!($payload)>
    };
}

/// A sample of such.
macro_rules! sample {
    (Zones $payload:tt) => {
        Heard
    };
    ($topic:ident $payload:tt) => {
        Received<scanhub_schema::payload_type!($payload)>
    };
}

/// Declares what is followed from the table of topics; a robot is all zones in one.
macro_rules! topics {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        enum Source { Robot(RobotFollower), $($topic(follower!($topic $payload)),)* }

        enum Held { Robot(Told), $($topic(sample!($topic $payload)),)* }

        impl Source {
            fn open(places: Vec<Domain>, sensor: &str, topic: Topic, wait: Wait) -> Result<Source, Failure> {
                Ok(match topic {
                    $(Topic::$topic => {
                        Source::$topic(<follower!($topic $payload)>::in_domain(places, sensor)?.wait_by(wait))
                    })*
                })
            }

            fn try_next(&mut self) -> Result<Option<Held>, Failure> {
                Ok(match self {
                    Source::Robot(robot) => robot.try_next()?.map(Told::new).map(Held::Robot),
                    $(Source::$topic(topic) => topic.try_next()?.map(Held::$topic),)*
                })
            }

            fn wait(&mut self, longest: Duration) -> Result<(), Failure> {
                match self {
                    Source::Robot(robot) => robot.wait(longest),
                    $(Source::$topic(topic) => topic.wait(longest),)*
                }
            }

            fn descriptor(&mut self) -> Result<c_int, Failure> {
                Ok(match self {
                    Source::Robot(robot) => robot.descriptor()?,
                    $(Source::$topic(topic) => topic.descriptor()?,)*
                }.as_raw_fd())
            }

            fn hub_lives(&self) -> bool {
                match self {
                    Source::Robot(robot) => robot.hub_lives(),
                    $(Source::$topic(topic) => topic.hub_lives(),)*
                }
            }
        }

        impl Held {
            fn lend(&self) -> Lent {
                match self {
                    Held::Robot(told) => Lent::new(None, told.verdict(), size_of_val(told.verdict())),
                    $(Held::$topic(sample) => sample.lend(),)*
                }
            }
        }
    };
}

scanhub_schema::for_each_topic!(topics);

/// What a program in C sees of a sample.
trait Lend {
    fn lend(&self) -> Lent;
}

impl Lend for Heard {
    fn lend(&self) -> Lent {
        let stale = self.stale.into();
        Lent {
            missed: self.missed,
            stale,
            ..Lent::new(self.header.as_ref(), &self.zones, size_of_val(&self.zones))
        }
    }
}

impl<P: Payload + ?Sized> Lend for Received<P> {
    fn lend(&self) -> Lent {
        let restarted = self.restarted.into();
        let length = self.bytes().len();
        Lent { missed: self.missed, restarted, ..Lent::new(Some(self.header()), &**self, length) }
    }
}

impl Handle {
    /// Will follow `topic` of `sensor` in the first live one of `places`.
    pub(crate) fn open(
        places: Vec<Domain>,
        sensor: &str,
        topic: Topic,
        wait: Wait,
    ) -> Result<Handle, CallError> {
        Ok(Handle::of(Source::open(places, sensor, topic, wait)?))
    }

    /// Will follow the robot of `sensors` (none: all) in the first live one of `places`, with its `early` warnings or without.
    pub(crate) fn open_robot(
        places: Vec<Domain>,
        sensors: &[&str],
        wait: Wait,
        early: bool,
    ) -> Result<Handle, CallError> {
        let robot = RobotFollower::in_domain(places, sensors)?.wait_by(wait);
        Ok(Handle::of(Source::Robot(if early { robot.with_early() } else { robot })))
    }

    fn of(source: Source) -> Handle {
        Handle { lent: Default::default(), found: None, next: 1, source }
    }

    /// Waits until there is a sample to take, or `timeout` is over (none: never); whether there is.
    pub(crate) fn wait(&mut self, timeout: Option<Duration>) -> Result<bool, CallError> {
        let until = timeout.and_then(|timeout| Instant::now().checked_add(timeout));
        loop {
            if self.found.is_none() {
                self.found = self.source.try_next()?;
            }
            if self.found.is_some() {
                return Ok(true);
            }
            let left = until.map_or(Duration::MAX, |until| until.saturating_duration_since(Instant::now()));
            if left.is_zero() {
                return Ok(false);
            }
            self.source.wait(left)?;
        }
    }

    /// The next sample, lent until it is given back; nothing if none waits.
    pub(crate) fn take(&mut self) -> Result<Option<Lent>, CallError> {
        let place = self.lent.iter_mut().find(|place| place.is_none());
        let Some(place) = place else {
            return Err(CallError::Argument("four samples are lent already", "scanhub_release one of them"));
        };
        let held = match self.found.take() {
            // A verdict is of now: the caller may have waited, and it has no stamp.
            Some(Held::Robot(found)) => match &mut self.source {
                Source::Robot(robot) => Held::Robot(Told::new(robot.now()?)),
                _ => Held::Robot(found),
            },
            Some(held) => held,
            None => match self.source.try_next()? {
                Some(held) => held,
                None => return Ok(None),
            },
        };
        let number = self.next;
        self.next += 1;
        let (number, held) = place.insert((number, held));
        Ok(Some(Lent { number: *number, ..held.lend() }))
    }

    /// Takes the sample back that was lent under `number`.
    pub(crate) fn give_back(&mut self, number: u64) -> Result<(), CallError> {
        let is_it =
            |place: &&mut Option<(u64, Held)>| place.as_ref().is_some_and(|(lent, _)| *lent == number);
        let place = self.lent.iter_mut().find(is_it);
        *place.ok_or(CallError::Argument("this sample is not lent", "release each sample once"))? = None;
        Ok(())
    }

    /// As [`Subscription::descriptor`].
    pub(crate) fn descriptor(&mut self) -> Result<c_int, CallError> {
        Ok(self.source.descriptor()?)
    }

    /// As [`Subscription::hub_lives`].
    pub(crate) fn hub_lives(&self) -> bool {
        self.source.hub_lives()
    }
}

impl Lent {
    fn new<P: ?Sized>(header: Option<&Header>, payload: &P, length: usize) -> Lent {
        Lent {
            header: header.map_or(ptr::null(), ptr::from_ref),
            payload: ptr::from_ref(payload).cast(),
            length,
            ..Lent::none()
        }
    }
}
