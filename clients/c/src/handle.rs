//! Objects behind the handles of a C program, and the table of the handles of a thread. An object is either a
//! subscription to any topic, with the samples that are lent to the program, or a mount whose angles the program
//! publishes.
//!
//! A handle is a number that looks like an address. Each number that C passes is searched in the table, and is never
//! dereferenced. A child after `fork` has a copy of the table and never uses this copy, because the samples and the
//! slots at the hub belong to the parent.

use std::any::Any;
use std::cell::RefCell;
use std::ffi::{CStr, CString, c_char, c_int};
use std::os::fd::AsRawFd;
use std::process;
use std::ptr;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use scanhub_client::{
    Error, Payload, PollableSubscriber, Publication, Received, Robot, RobotSubscriber, Silence, Subscribe,
    Subscriber, SubscriberBuilder, Wait, ZonesUpdate, publish_domain,
};
use scanhub_schema::{Failure, Header, Kind, Tilt, Topic, limits};

use crate::ffi::{BorrowedSample, CallError};
use crate::silence::{silence_number, silence_text};

/// Open subscription, with the samples that it has lent.
pub(crate) struct Handle {
    // This field is first, so that samples are dropped before the source that lends them.
    loans: [Option<(u64, Held)>; MAX_LOANS],
    found: Option<Held>,
    next: u64,
    source: Source,
    /// Text of the last reason for a silence. The program may read the text until the next call.
    silence: CString,
}

/// Maximum number of samples that a handle lends at a time. It is the number of samples that a subscriber can borrow
/// from the hub.
const MAX_LOANS: usize = limits::MAX_BORROWED_SAMPLES;

/// Selects the subscriber type of a topic. Zones have their own type, because they expire, in contrast to other
/// samples.
macro_rules! kind {
    (Zones $payload:tt) => {
        ZonesUpdate
    };
    ($topic:ident $payload:tt) => {
        scanhub_schema::payload_type!($payload)
    };
}

/// Subscriber with the chosen method of waiting. Only a subscriber that waits by event has a descriptor.
enum Port<T: Subscribe + ?Sized> {
    Sleeping(Subscriber<T>),
    Pollable(PollableSubscriber<T>),
}

impl<T: Subscribe + ?Sized> Port<T> {
    /// Opens the subscriber in `domain`, or in the domain that the environment names.
    fn open(builder: SubscriberBuilder<T>, domain: Option<&str>, wait: Wait) -> Result<Port<T>, Error> {
        let builder = match domain {
            Some(domain) => builder.domain(domain),
            None => builder,
        };
        Ok(match wait {
            Wait::Event => Port::Pollable(builder.open_pollable()?),
            _ => Port::Sleeping(builder.wait(wait).open()?),
        })
    }

    fn subscriber_mut(&mut self) -> &mut Subscriber<T> {
        match self {
            Port::Sleeping(subscriber) => subscriber,
            Port::Pollable(pollable) => pollable.subscriber_mut(),
        }
    }

    fn descriptor(&self) -> Result<c_int, Error> {
        match self {
            Port::Pollable(pollable) => Ok(pollable.as_raw_fd()),
            Port::Sleeping(_) => {
                let hint = "open it with SCANHUB_WAIT_EVENT: only then is there a descriptor";
                Err(Failure::new(Kind::Configuration, "no descriptor to wait on", hint).into())
            }
        }
    }
}

/// Declares the enums of sources and samples from the table of topics. A robot combines the zones of its sensors.
macro_rules! topics {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        enum Source { Robot(Port<Robot>), $($topic(Port<kind!($topic $payload)>),)* }

        enum Held { Robot(OwnedVerdict), $($topic(<kind!($topic $payload) as Subscribe>::Item),)* }

        impl Source {
            fn open(domain: Option<&str>, sensor: &str, topic: Topic, wait: Wait) -> Result<Source, Error> {
                Ok(match topic {
                    $(Topic::$topic => {
                        let builder = Subscriber::<kind!($topic $payload)>::builder(sensor);
                        Source::$topic(Port::open(builder, domain, wait)?)
                    })*
                })
            }

            fn try_next(&mut self) -> Result<Option<Held>, Error> {
                Ok(match self {
                    Source::Robot(robot) => robot.subscriber_mut().try_next()?.map(|robot| Held::Robot(OwnedVerdict::new(&robot))),
                    $(Source::$topic(topic) => topic.subscriber_mut().try_next()?.map(Held::$topic),)*
                })
            }

            fn wait(&mut self, longest: Duration) -> Result<(), Error> {
                match self {
                    Source::Robot(robot) => robot.subscriber_mut().wait(longest),
                    $(Source::$topic(topic) => topic.subscriber_mut().wait(longest),)*
                }
            }

            fn descriptor(&self) -> Result<c_int, Error> {
                match self {
                    Source::Robot(robot) => robot.descriptor(),
                    $(Source::$topic(topic) => topic.descriptor(),)*
                }
            }

            fn hub_is_running(&mut self) -> bool {
                match self {
                    Source::Robot(robot) => robot.subscriber_mut().hub_is_running(),
                    $(Source::$topic(topic) => topic.subscriber_mut().hub_is_running(),)*
                }
            }

            fn silent_for(&mut self) -> Duration {
                match self {
                    Source::Robot(robot) => robot.subscriber_mut().silent_for(),
                    $(Source::$topic(topic) => topic.subscriber_mut().silent_for(),)*
                }
            }

            fn why_silent(&mut self) -> Silence {
                match self {
                    Source::Robot(robot) => robot.subscriber_mut().why_silent(),
                    $(Source::$topic(topic) => topic.subscriber_mut().why_silent(),)*
                }
            }
        }

        impl Held {
            fn lend(&self) -> BorrowedSample {
                match self {
                    Held::Robot(update) => BorrowedSample::new(None, update.verdict(), size_of_val(update.verdict())),
                    $(Held::$topic(sample) => sample.lend(),)*
                }
            }
        }
    };
}

scanhub_schema::for_each_topic!(topics);

/// Conversion of a sample to the struct that a C program reads.
trait Lend {
    fn lend(&self) -> BorrowedSample;
}

impl Lend for ZonesUpdate {
    fn lend(&self) -> BorrowedSample {
        let stale = self.stale.into();
        BorrowedSample {
            missed: self.missed,
            stale,
            ..BorrowedSample::new(self.header.as_ref(), &self.zones, size_of_val(&self.zones))
        }
    }
}

impl<P: Payload + ?Sized> Lend for Received<P> {
    fn lend(&self) -> BorrowedSample {
        let restarted = self.restarted.into();
        let length = self.bytes().len();
        BorrowedSample {
            missed: self.missed,
            restarted,
            ..BorrowedSample::new(Some(self.header()), &**self, length)
        }
    }
}

impl Handle {
    /// Subscribes to `topic` of `sensor` in `domain`, or in the domain that the environment names.
    pub(crate) fn open(
        domain: Option<&str>,
        sensor: &str,
        topic: Topic,
        wait: Wait,
    ) -> Result<Handle, CallError> {
        Ok(Handle::of(Source::open(domain, sensor, topic, wait)?))
    }

    /// Subscribes to the verdict over the zones of `sensors` in `domain`, with or without `early` warnings. An empty
    /// list means all sensors. Without `domain`, the environment names the domain, as for [`open`](Self::open).
    pub(crate) fn open_robot(
        domain: Option<&str>,
        sensors: &[&str],
        wait: Wait,
        early: bool,
    ) -> Result<Handle, CallError> {
        let robot = RobotSubscriber::builder(sensors);
        let robot = if early { robot.early() } else { robot };
        Ok(Handle::of(Source::Robot(Port::open(robot, domain, wait)?)))
    }

    fn of(source: Source) -> Handle {
        Handle { loans: Default::default(), found: None, next: 1, source, silence: CString::default() }
    }

    /// Waits until a sample can be taken, but not longer than `timeout`. Returns whether a sample can be taken.
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

    /// Lends the next sample until [`release`](Self::release). Returns `None` if no sample has arrived.
    pub(crate) fn take(&mut self) -> Result<Option<BorrowedSample>, CallError> {
        let slot = self.loans.iter_mut().find(|slot| slot.is_none());
        let Some(slot) = slot else {
            return Err(CallError::Argument("four samples are lent already", "scanhub_release one of them"));
        };
        let held = match self.found.take() {
            // The verdict may have changed since `wait` found it, and it has no stamp that would show its age. So lend
            // the current verdict instead.
            Some(Held::Robot(found)) => match &mut self.source {
                Source::Robot(robot) => Held::Robot(OwnedVerdict::new(robot.subscriber_mut().now()?)),
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
        let (number, held) = slot.insert((number, held));
        Ok(Some(BorrowedSample { number: *number, ..held.lend() }))
    }

    /// Releases the sample that was lent under `number`.
    pub(crate) fn release(&mut self, number: u64) -> Result<(), CallError> {
        let is_loan =
            |slot: &&mut Option<(u64, Held)>| slot.as_ref().is_some_and(|(loan, _)| *loan == number);
        let slot = self.loans.iter_mut().find(is_loan);
        *slot.ok_or(CallError::Argument("this sample is not lent", "release each sample once"))? = None;
        Ok(())
    }

    /// Returns the descriptor of a handle that waits by event, see [`PollableSubscriber`].
    pub(crate) fn descriptor(&self) -> Result<c_int, CallError> {
        Ok(self.source.descriptor()?)
    }

    /// Returns whether a hub runs in the domain, as [`Subscriber::hub_is_running`] does.
    pub(crate) fn hub_is_running(&mut self) -> bool {
        self.source.hub_is_running()
    }

    /// Returns the time since the last sample, as [`Subscriber::silent_for`] does.
    pub(crate) fn silent_for(&mut self) -> Duration {
        self.source.silent_for()
    }

    /// Returns why no sample arrives, as [`Subscriber::why_silent`] does: the number SCANHUB_SILENCE_.. of the header,
    /// and the text, which is valid until the next call.
    pub(crate) fn why_silent(&mut self) -> (c_int, &CStr) {
        let silence = self.source.why_silent();
        // Messages are printable, so they contain no 0.
        self.silence = CString::new(silence_text(&silence)).unwrap_or_default();
        (silence_number(&silence), &self.silence)
    }
}

impl BorrowedSample {
    fn new<P: ?Sized>(header: Option<&Header>, payload: &P, length: usize) -> BorrowedSample {
        BorrowedSample {
            header: header.map_or(ptr::null(), ptr::from_ref),
            payload: ptr::from_ref(payload).cast(),
            length,
            ..BorrowedSample::none()
        }
    }
}

/// `scanhub_robot` of the header.
#[repr(C)]
struct Verdict {
    verdict: u8,
    nearest_mm: u32,
    worst: *const c_char,
    nearest: *const c_char,
    count: usize,
    sensors: *const SensorVerdict,
}

/// `scanhub_robot_sensor` of the header.
#[repr(C)]
struct SensorVerdict {
    name: *const c_char,
    verdict: u8,
    nearest_mm: u32,
}

/// Verdict of a robot, with the memory to which the verdict points. C may read both while the verdict is lent.
struct OwnedVerdict {
    verdict: Verdict,
    _sensors: Box<[SensorVerdict]>,
    _names: Vec<CString>,
}

impl OwnedVerdict {
    fn new(robot: &Robot) -> OwnedVerdict {
        // Names contain no 0.
        let names: Vec<CString> =
            robot.zones().map(|(name, _)| CString::new(name).unwrap_or_default()).collect();
        let of_sensor = |((_, zones), name): ((&str, &scanhub_schema::Zones), &CString)| SensorVerdict {
            name: name.as_ptr(),
            verdict: zones.verdict() as u8,
            nearest_mm: zones.nearest().map_or(NOTHING_MM, |(_, mm)| mm),
        };
        let sensors: Box<[SensorVerdict]> = robot.zones().zip(&names).map(of_sensor).collect();
        let called = |sensor: Option<&str>| {
            let at = robot.zones().position(|(name, _)| Some(name) == sensor);
            at.map_or(ptr::null(), |at| names[at].as_ptr())
        };
        let nearest = robot.nearest();
        let verdict = Verdict {
            verdict: robot.verdict() as u8,
            nearest_mm: nearest.map_or(NOTHING_MM, |(mm, _)| mm),
            worst: called(robot.worst()),
            nearest: called(nearest.map(|(_, name)| name)),
            count: sensors.len(),
            sensors: sensors.as_ptr(),
        };
        OwnedVerdict { verdict, _sensors: sensors, _names: names }
    }

    /// Returns the struct that is lent. The memory to which the struct points exists as long as `self`.
    fn verdict(&self) -> &Verdict {
        &self.verdict
    }
}

/// SCANHUB_NOTHING_MM of the header.
const NOTHING_MM: u32 = u32::MAX;

/// Mount whose angles are published.
pub(crate) struct Mount(Publication<Tilt>);

impl Mount {
    /// Starts to publish as `name` in `domain`, or in the domain that the environment names.
    pub(crate) fn publish(domain: Option<&str>, name: &str) -> Result<Mount, CallError> {
        Ok(Mount(Publication::in_domain(&publish_domain(domain)?, name)?))
    }

    /// Publishes the angle of the mount at `stamp_ns` of CLOCK_MONOTONIC; 0 means now.
    pub(crate) fn send(&mut self, stamp_ns: u64, tilt: Tilt) -> Result<(), CallError> {
        let fill = |sample: &mut Tilt| *sample = tilt;
        Ok(if stamp_ns == 0 { self.0.send(fill) } else { self.0.send_at(stamp_ns, fill) }?)
    }
}

/// `struct scanhub_attachment` and `struct scanhub_publication` of the header. No value of this type exists.
#[repr(C)]
pub struct Opaque {
    _nothing: [u8; 0],
}

thread_local! {
    static TABLE: RefCell<Vec<Entry>> = const { RefCell::new(Vec::new()) };
}

/// Object in the table of a thread.
struct Entry {
    number: usize,
    process: u32,
    /// The object, in a box of its own, because the samples that it lends must not move when the table grows. `None`
    /// only while the entry is dropped.
    object: Option<Box<dyn Any>>,
}

impl Entry {
    fn has_handle(&self, handle: *mut Opaque) -> bool {
        self.number == handle.addr() && self.process == process::id()
    }
}

impl Drop for Entry {
    fn drop(&mut self) {
        let object = self.object.take();
        if self.process != process::id() {
            // In a child, the object is not dropped. Keep its address, so that a leak checker reports no leak.
            let mut kept = INHERITED.lock().unwrap_or_else(PoisonError::into_inner);
            kept.extend(object.map(|object| Box::into_raw(object).expose_provenance()));
        }
    }
}

/// Addresses of the objects that a child inherited from its parent and does not drop.
static INHERITED: Mutex<Vec<usize>> = Mutex::new(Vec::new());

/// Next number of a handle. A process uses no number twice.
static NEXT: AtomicUsize = AtomicUsize::new(1);

/// Stores `object` for this thread, and returns its handle.
pub(crate) fn insert<T: Any>(object: T) -> Result<*mut Opaque, CallError> {
    let number = NEXT.fetch_add(1, Ordering::Relaxed);
    let entry = Entry { number, process: process::id(), object: Some(Box::new(object)) };
    let kept = TABLE.try_with(|table| table.borrow_mut().push(entry));
    kept.map(|()| ptr::without_provenance_mut(number)).map_err(|_| UNKNOWN_HANDLE)
}

/// Calls `use_it` with the object of `handle`, if the object has type `T`.
pub(crate) fn with<T: Any, R>(
    handle: *mut Opaque,
    use_it: impl FnOnce(&mut T) -> Result<R, CallError>,
) -> Result<R, CallError> {
    let found = TABLE.try_with(|table| {
        let mut table = table.borrow_mut();
        let entry = table.iter_mut().find(|entry| entry.has_handle(handle));
        use_it(entry.and_then(|entry| entry.object.as_mut()?.downcast_mut()).ok_or(UNKNOWN_HANDLE)?)
    });
    found.unwrap_or(Err(UNKNOWN_HANDLE))
}

/// Drops the object of `handle` with everything that the object holds, if the object has type `T`.
pub(crate) fn remove<T: Any>(handle: *mut Opaque) -> Result<(), CallError> {
    let removed = TABLE.try_with(|table| {
        let mut table = table.borrow_mut();
        let has_type = |entry: &Entry| entry.object.as_ref().is_some_and(|object| object.is::<T>());
        let at = table.iter().position(|entry| entry.has_handle(handle) && has_type(entry));
        Ok(table.swap_remove(at.ok_or(UNKNOWN_HANDLE)?))
    });
    removed.unwrap_or(Err(UNKNOWN_HANDLE)).map(drop)
}

const UNKNOWN_HANDLE: CallError = CallError::Argument(
    "this thread has no such handle",
    "use a handle only until it is closed, and only in the thread that opened it; a child opens its own",
);
