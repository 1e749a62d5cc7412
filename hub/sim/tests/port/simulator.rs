//! The verb in a thread, a place for its files, and what it says of itself.

use std::io::Write;
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::Instant;

use scanhub_schema::Failure;
use scanhub_sim::fault::Fault;
use scanhub_sim::options::SimulateOptions;
use scanhub_sim::simulate::{Record, Summary};
use scanhub_sim::{Ready, simulate};
use tempfile::TempDir;

use crate::PATIENCE;

/// A temporary directory.
pub(crate) struct Folder(TempDir);

impl Folder {
    pub(crate) fn new() -> Folder {
        Folder(TempDir::new().unwrap())
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }
}

/// A simulator in a thread.
pub(crate) struct Simulator {
    stop: Option<UnixStream>,
    thread: Option<thread::JoinHandle<Result<Vec<Summary>, Failure>>>,
    pub(crate) records: Receiver<Record>,
    pub(crate) ready: Vec<Ready>,
}

impl Simulator {
    pub(crate) fn start(options: SimulateOptions) -> Simulator {
        let (stop, stopped) = UnixStream::pair().unwrap();
        let (send_record, records) = channel();
        let (send_ready, ready) = channel();
        let thread = thread::spawn(move || {
            let send_record = Mutex::new(send_record);
            let tell = |record: &Record| {
                let _ = send_record.lock().unwrap().send(record.clone());
            };
            simulate(&options, &stopped, |ready| send_ready.send(ready.to_vec()).unwrap(), tell)
        });
        let ready = ready.recv_timeout(PATIENCE).expect("ready");
        Simulator { stop: Some(stop), thread: Some(thread), records, ready }
    }

    pub(crate) fn record(&self) -> Record {
        self.records.recv_timeout(PATIENCE).expect("a telegram is sent")
    }

    /// The first record from now on that `wanted` is about.
    pub(crate) fn record_where(&self, wanted: impl Fn(&Record) -> bool) -> Record {
        let end = Instant::now() + PATIENCE;
        while Instant::now() < end {
            let record = self.record();
            if wanted(&record) {
                return record;
            }
        }
        panic!("no such telegram was sent");
    }

    /// What was sent that did not arrive, as far as nobody asked yet.
    pub(crate) fn faults(&self) -> Vec<(u64, Fault)> {
        self.records.try_iter().filter_map(|record| Some((record.index, record.fault?))).collect()
    }

    pub(crate) fn end(mut self) -> (Vec<Summary>, Vec<Record>) {
        self.stop.take().unwrap().write_all(b"x").unwrap();
        let summaries = self.thread.take().unwrap().join().unwrap().unwrap();
        (summaries, self.records.iter().collect())
    }
}
