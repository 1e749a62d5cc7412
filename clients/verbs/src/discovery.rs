//! Lists the sensors of a hub in a background thread. Listing takes milliseconds, and would delay datagrams, which take
//! only microseconds.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use scanhub_schema::{Failure, PublisherKind, Topic};
use scanhub_shm::Domain;

/// Repeated listing of the current hub's sensors. A list is one complete search for sensors.
#[derive(Default)]
pub struct Discovery {
    /// Time at which the hub appeared, and the number of lists that were started since then.
    hub: Option<(Instant, usize)>,
    /// Current list, and the age of the hub at the start of the list.
    task: Option<(BackgroundTask<Answer>, Duration)>,
    /// Whether a list has succeeded or failed since the hub appeared. Later failures are ignored.
    has_reply: bool,
    /// Time of the last change of the domain's services, as read before the current list and before the last complete
    /// list.
    task_change: Option<SystemTime>,
    reply_change: Option<SystemTime>,
}

type Answer = Result<Vec<(String, Topic)>, Failure>;

/// Result of a list.
pub struct DiscoveryReply {
    /// Names of the sensors that have topics, sorted.
    pub sensors: Vec<String>,
    /// Sensors, and the kind of publisher that has created the topics of each. A sensor may occur more than once.
    publisher_kinds: Vec<(String, PublisherKind)>,
    /// Age of the hub at the start of the list.
    pub age: Duration,
}

/// Ages of a hub at which its sensors are listed. The hub creates its topics one after the other, so the first lists
/// may be incomplete.
const DISCOVERY_TIMES: [Duration; 4] =
    [Duration::ZERO, Duration::from_millis(200), Duration::from_secs(1), Duration::from_secs(5)];
/// Interval between later lists. A tracker or a remote sensor may appear at any time.
const REPEAT_INTERVAL: Duration = Duration::from_secs(10);

/// Returns the age of the hub at which the next list is due after `calls` lists.
fn due_after(calls: usize) -> Duration {
    let last = DISCOVERY_TIMES[DISCOVERY_TIMES.len() - 1];
    let more = u32::try_from((calls + 1).saturating_sub(DISCOVERY_TIMES.len())).unwrap_or(u32::MAX);
    DISCOVERY_TIMES
        .get(calls)
        .copied()
        .unwrap_or_else(|| last.saturating_add(REPEAT_INTERVAL.saturating_mul(more)))
}

/// Directory of a domain with one file for each service.
const SERVICES_DIRECTORY: &str = "services";
/// Time after which all files of a new service are complete.
const COMPLETE_AFTER: Duration = Duration::from_secs(5);

/// A list whose number is a multiple of this value is made even if the services are unchanged. An earlier list may have
/// missed services that could not be opened, for example because descriptors ran out.
const RELIST_PERIOD: usize = 6;

/// Interval at which the caller polls for the result.
const POLL_INTERVAL: Duration = Duration::from_millis(5);

impl DiscoveryReply {
    fn of(published: &[(String, Topic)], age: Duration) -> DiscoveryReply {
        let mut sensors: Vec<String> = published.iter().map(|(name, _)| name.clone()).collect();
        sensors.dedup();
        let publisher_kinds =
            published.iter().map(|(name, topic)| (name.clone(), topic.publisher_kind())).collect();
        DiscoveryReply { sensors, publisher_kinds, age }
    }

    /// Returns whether `sensor` has `topic`, or will have it when its publisher has created all topics. A publisher
    /// creates all topics of its kind.
    pub fn may_have(&self, sensor: &str, topic: Topic) -> bool {
        self.publisher_kinds.iter().any(|(name, kind)| name == sensor && *kind == topic.publisher_kind())
    }
}

impl Discovery {
    /// Restarts the search for a new hub. Results about the previous hub are dropped.
    pub fn on_hub_started(&mut self, now: Instant) {
        *self = Discovery { hub: Some((now, 0)), ..Discovery::default() };
    }

    /// Drops the current list, because the hub has exited.
    pub fn on_hub_ended(&mut self) {
        self.task = None;
    }

    /// Returns whether a hub has been found since this discovery was created.
    pub fn has_seen_hub(&self) -> bool {
        self.hub.is_some()
    }

    /// Starts a list of the sensors of the hub in `domain` if one is due. When a list is complete, returns its result
    /// once. A list is skipped while the services of the domain are unchanged, because it executes a million
    /// instructions for each service. Before lists were skipped, they took half of a gateway's CPU time.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`](scanhub_schema::Kind) if no list has succeeded yet. A later failure keeps the known
    /// sensors.
    pub fn poll(&mut self, domain: &Domain, now: Instant) -> Result<Option<DiscoveryReply>, Failure> {
        if let Some((task, age)) = &self.task {
            let Some(answer) = task.result() else { return Ok(None) };
            let reply = answer.map(|published| DiscoveryReply::of(&published, *age));
            self.task = None;
            if self.has_reply && reply.is_err() {
                return Ok(None);
            }
            self.has_reply = true;
            self.reply_change = self.task_change.filter(|_| reply.is_ok());
            return reply.map(Some);
        }
        let Some((started, calls)) = &mut self.hub else { return Ok(None) };
        let age = now - *started;
        if age >= due_after(*calls) {
            let changed = last_change(domain);
            // Do not skip the first lists, because callers also use them to report a missing sensor.
            let may_skip = *calls > DISCOVERY_TIMES.len() && !calls.is_multiple_of(RELIST_PERIOD);
            if may_skip && changed.is_some() && changed == self.reply_change {
                *calls += 1;
                return Ok(None);
            }
            let domain = domain.clone();
            self.task =
                BackgroundTask::begin(move || scanhub_shm::published_topics(&domain)).map(|task| (task, age));
            *calls += usize::from(self.task.is_some());
            self.task_change = changed;
        }
        Ok(None)
    }

    /// Returns the time after which to poll again; `None` if no list is running.
    pub fn time_left(&self) -> Option<Duration> {
        self.task.as_ref().map(|_| POLL_INTERVAL)
    }
}

/// Returns the time at which a service of `domain` was last created or removed. Returns `None` if the time is unknown,
/// or so recent that a service may still be incomplete and missing from a list.
fn last_change(domain: &Domain) -> Option<SystemTime> {
    let changed = std::fs::metadata(domain.root().join(SERVICES_DIRECTORY)).ok()?.modified().ok()?;
    changed.elapsed().is_ok_and(|age| age >= COMPLETE_AFTER).then_some(changed)
}

/// Slow work in a separate thread, so that a sending thread waits only for samples. If the task is dropped, its result
/// is discarded.
#[derive(Debug)]
pub struct BackgroundTask<T>(Receiver<T>);

/// Interval at which [`BackgroundTask::wait`] checks whether it must stop.
const STOP_CHECK_INTERVAL: Duration = Duration::from_millis(50);

impl<T: Send + 'static> BackgroundTask<T> {
    /// Starts the work. Returns `None` if no thread can be created. The caller then tries again later.
    pub fn begin(work: impl FnOnce() -> T + Send + 'static) -> Option<BackgroundTask<T>> {
        let (done, result) = channel();
        let thread = thread::Builder::new().name("errand".into()).spawn(move || {
            let _ = done.send(work());
        });
        thread.ok().map(|_| BackgroundTask(result))
    }

    /// Returns the result if the work has ended. Only one call returns the result.
    pub fn result(&self) -> Option<T> {
        self.0.try_recv().ok()
    }

    /// Waits for the result, and returns it. Returns `None` if `stop` is set first.
    pub fn wait(&self, stop: &AtomicBool) -> Option<T> {
        while !stop.load(Ordering::Relaxed) {
            match self.0.recv_timeout(STOP_CHECK_INTERVAL) {
                Err(RecvTimeoutError::Timeout) => {}
                result => return result.ok(),
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn link_and_tracker_have_different_topics() {
        let published = [("front", Topic::Scan), ("front", Topic::Status), ("house", Topic::Tracks)];
        let published = published.map(|(sensor, topic)| (sensor.to_owned(), topic));
        let called = DiscoveryReply::of(&published, Duration::ZERO);
        assert_eq!(called.sensors, ["front", "house"]);
        assert!(called.may_have("front", Topic::Marks) && !called.may_have("front", Topic::Events));
        assert!(called.may_have("house", Topic::Events) && !called.may_have("house", Topic::Scan));
    }

    #[test]
    fn discovery_interval_grows_to_10_s() {
        let due: Vec<u64> = (0..6).map(|calls| due_after(calls).as_secs()).collect();
        assert_eq!(due, [0, 0, 1, 5, 15, 25]);
    }

    #[test]
    fn unchanged_services_are_not_listed_again() {
        let place = tempfile::tempdir().unwrap();
        let domain = Domain::at("answers", place.path()).unwrap();
        let services = domain.root().join(SERVICES_DIRECTORY);
        std::fs::create_dir_all(&services).unwrap();
        let began = Instant::now();
        let mut discovery = Discovery::default();
        discovery.on_hub_started(began);
        let mut lists_at = |seconds: u64| {
            let now = began + Duration::from_secs(seconds);
            let called = discovery.poll(&domain, now).unwrap();
            let is_listed = discovery.task.is_some();
            while discovery.task.is_some() {
                discovery.poll(&domain, now).unwrap();
            }
            assert!(called.is_none());
            is_listed
        };
        assert_eq!([0, 1, 2].map(&mut lists_at), [true; 3]);
        let old = SystemTime::now() - Duration::from_secs(60);
        std::fs::File::open(&services).unwrap().set_modified(old).unwrap();
        // The list at 36 s is the sixth, which is made although the services are unchanged.
        assert_eq!([6, 16, 26, 36].map(&mut lists_at), [true, true, false, true]);
        std::fs::write(services.join("another"), "").unwrap();
        assert_eq!([46, 56].map(&mut lists_at), [true; 2], "a service may be incomplete");
    }

    #[test]
    fn listing_error_is_ignored_once_sensors_are_known() {
        let mut discovery = Discovery::default();
        let domain = Domain::at("answers", std::path::Path::new("/tmp")).unwrap();
        let mut answer = |answer: Answer| {
            discovery.task = BackgroundTask::begin(|| answer).map(|task| (task, Duration::ZERO));
            loop {
                let called = discovery.poll(&domain, Instant::now());
                if discovery.task.is_none() {
                    return called.map(|called| called.map(|called| called.sensors));
                }
            }
        };
        let short = || {
            Err(Failure::new(scanhub_schema::Kind::ResourceExhausted, "no descriptor is left", "ulimit -n"))
        };
        assert!(answer(short()).is_err());
        assert_eq!(answer(Ok(vec![("front".to_owned(), Topic::Scan)])), Ok(Some(vec!["front".to_owned()])));
        assert_eq!(answer(short()), Ok(None));
    }

    #[test]
    fn no_poll_is_due_after_the_hub_has_ended() {
        let mut discovery = Discovery::default();
        discovery.on_hub_started(Instant::now());
        assert_eq!(discovery.time_left(), None);
        discovery.task = BackgroundTask::begin(|| Ok(Vec::new())).map(|task| (task, Duration::ZERO));
        assert_eq!(discovery.time_left(), Some(POLL_INTERVAL));
        discovery.on_hub_ended();
        assert!(discovery.time_left().is_none() && discovery.has_seen_hub());
    }

    #[test]
    fn polling_a_background_task_does_not_block() {
        let (go, hold) = channel();
        let task = BackgroundTask::begin(move || hold.recv()).unwrap();
        assert_eq!(task.result(), None);
        go.send(7).unwrap();
        let give_up_at = Instant::now() + Duration::from_secs(30);
        let result = loop {
            match task.result() {
                Some(result) => break result,
                None => assert!(Instant::now() < give_up_at),
            }
            thread::yield_now();
        };
        assert_eq!((result, task.result()), (Ok(7), None));
    }

    #[test]
    fn waiting_for_a_background_task_can_be_stopped() {
        let (go, hold) = channel();
        let task = BackgroundTask::begin(move || hold.recv()).unwrap();
        assert_eq!(task.wait(&AtomicBool::new(true)), None);
        go.send(7).unwrap();
        assert_eq!(task.wait(&AtomicBool::new(false)), Some(Ok(7)));
    }
}
