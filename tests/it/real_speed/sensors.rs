//! Simulated sensors in threads of the test. The test applies events to them while they run, and records everything
//! that they send.

use std::collections::{HashMap, VecDeque};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};

use scanhub_schema::Failure;
use scanhub_sim::options::SimulateOptions;
use scanhub_sim::simulate::{Record, Summary};
use scanhub_sim::{Event, simulate_with};

use crate::testkit::{TestEnv, WAIT_TIMEOUT};

/// Names of sensors and their ports.
pub(super) const SENSORS: [&str; 2] = ["s0", "s1"];

/// The running simulator.
pub(super) struct Sensors {
    stop: UnixStream,
    events: Events,
    thread: JoinHandle<Result<Vec<Summary>, Failure>>,
    records: Receiver<Record>,
}

/// Events that were not applied yet, by port.
type Events = Arc<Mutex<HashMap<PathBuf, VecDeque<Event>>>>;

impl Sensors {
    /// Starts sensors that have just been powered on, and waits until their ports can be opened.
    pub(super) fn start(env: &TestEnv, seed: u64) -> Sensors {
        let ports = SENSORS.map(|name| env.path(name));
        let options = SimulateOptions { ports: ports.to_vec(), seed, ..SimulateOptions::default() };
        let (stop, stopped) = UnixStream::pair().expect("a pair of sockets");
        let events: Events = Arc::new(Mutex::new(ports.map(|port| (port, VecDeque::new())).into()));
        let (record_sender, records) = channel();
        let (say_ready, is_ready) = channel();
        let event_queue = events.clone();
        let thread = thread::spawn(move || {
            let record_sender = Mutex::new(record_sender);
            simulate_with(
                &options,
                &stopped,
                |_| say_ready.send(()).expect("a waiting test"),
                |record| {
                    // Sending fails if the test has dropped the receiver, because it then needs no more records.
                    let _ = record_sender.lock().expect("an intact mutex").send(record.clone());
                },
                |port| event_queue.lock().expect("an intact mutex").get_mut(port)?.pop_front(),
                |_, _| {},
            )
        });
        is_ready.recv_timeout(WAIT_TIMEOUT).expect("ports can be opened");
        Sensors { stop, events, thread, records }
    }

    /// Applies `event` to the sensor with the index `sensor`.
    pub(super) fn inject(&self, env: &TestEnv, sensor: usize, event: Event) {
        let mut events = self.events.lock().expect("an intact mutex");
        events.get_mut(&env.path(SENSORS[sensor])).expect("a sensor").push_back(event);
    }

    /// Ends the simulator. Returns the records that each sensor sent, in the order of sending, and the summaries.
    pub(super) fn end(self, env: &TestEnv) -> ([Vec<Record>; 2], Vec<Summary>) {
        drop(self.stop);
        let summaries =
            self.thread.join().expect("a thread that does not panic").expect("a run without an error");
        let records: Vec<Record> = self.records.into_iter().collect();
        let of = |name| {
            let port = env.path(name);
            records.iter().filter(|record| record.port == port).cloned().collect()
        };
        (SENSORS.map(of), summaries)
    }
}
