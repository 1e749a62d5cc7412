//! A bench for tests of the verb `simulate`: a simulator in a thread, a directory for its files, and a host. The host
//! opens the simulator's port, writes requests, and finds the telegrams in the received bytes.

use std::io::Write;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags, open};
use rustix::io::Errno;
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};
use scanhub_drivers::lms;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::framer::{Framer, FramerEvent};
use scanhub_schema::Failure;
use scanhub_sim::fault::Fault;
use scanhub_sim::options::SimulateOptions;
use scanhub_sim::simulate::{Record, Summary};
use scanhub_sim::{SimulatedPort, simulate};
use tempfile::TempDir;

use crate::WAIT_TIMEOUT;

/// A temporary directory.
pub(crate) struct TestFolder(TempDir);

impl TestFolder {
    pub(crate) fn new() -> TestFolder {
        TestFolder(TempDir::new().unwrap())
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
    pub(crate) ready: Vec<SimulatedPort>,
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
        let ready = ready.recv_timeout(WAIT_TIMEOUT).expect("ready");
        Simulator { stop: Some(stop), thread: Some(thread), records, ready }
    }

    pub(crate) fn record(&self) -> Record {
        self.records.recv_timeout(WAIT_TIMEOUT).expect("a telegram is sent")
    }

    /// Returns the next record for which `is_expected` returns true.
    pub(crate) fn record_where(&self, is_expected: impl Fn(&Record) -> bool) -> Record {
        let end = Instant::now() + WAIT_TIMEOUT;
        while Instant::now() < end {
            let record = self.record();
            if is_expected(&record) {
                return record;
            }
        }
        panic!("no such telegram was sent");
    }

    /// Returns index and fault of each telegram that did not arrive intact, of all telegrams since the last call.
    pub(crate) fn faults(&self) -> Vec<(u64, Fault)> {
        self.records.try_iter().filter_map(|record| Some((record.index, record.fault?))).collect()
    }

    pub(crate) fn end(mut self) -> (Vec<Summary>, Vec<Record>) {
        self.stop.take().unwrap().write_all(b"x").unwrap();
        let summaries = self.thread.take().unwrap().join().unwrap().unwrap();
        (summaries, self.records.iter().collect())
    }
}

/// A host that has the simulator's port open.
pub(crate) struct Host {
    pub(crate) port: OwnedFd,
    framer: Framer,
}

impl Host {
    pub(crate) fn open(path: &Path, rate: u32) -> Host {
        Host::try_open(path, rate).unwrap()
    }

    /// Opens a port, or fails if the port is unplugged.
    pub(crate) fn try_open(path: &Path, rate: u32) -> Result<Host, Errno> {
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let host = Host { port: open(path, flags, Mode::empty())?, framer: Framer::default() };
        host.try_set_rate(rate)?;
        Ok(host)
    }

    pub(crate) fn set_rate(&self, rate: u32) {
        self.try_set_rate(rate).unwrap();
    }

    fn try_set_rate(&self, rate: u32) -> Result<(), Errno> {
        let mut termios = tcgetattr(&self.port)?;
        termios.make_raw();
        termios.set_speed(rate)?;
        tcsetattr(&self.port, OptionalActions::Now, &termios)
    }

    /// Writes all bytes of `request` at once, like most drivers. A UART would add gaps.
    pub(crate) fn write(&self, request: Request) {
        let encoded = request.encode(0);
        assert_eq!(rustix::io::write(&self.port, encoded.bytes()), Ok(encoded.bytes().len()));
    }

    /// Returns the next telegram that arrives within `timeout`. Returns `None` if no telegram arrives or the port is
    /// unplugged.
    pub(crate) fn telegram(&mut self, timeout: Duration) -> Option<Vec<u8>> {
        let end = Instant::now() + timeout;
        loop {
            while let Some(found) = self.framer.poll() {
                if let FramerEvent::Telegram(framed) = found {
                    return Some(framed.telegram.bytes().to_vec());
                }
            }
            let left = end.saturating_duration_since(Instant::now());
            let timeout = Timespec { tv_sec: left.as_secs() as _, tv_nsec: left.subsec_nanos() as _ };
            let mut fds = [PollFd::new(&self.port, PollFlags::IN)];
            if poll(&mut fds, Some(&timeout)).unwrap() == 0 {
                // If the end of a frame looks like the start of a telegram, the framer holds the frame until the line
                // is silent.
                self.framer.release(lms::framer::VETO_HOLD_TIME);
                if let Some(FramerEvent::Telegram(framed)) = self.framer.poll() {
                    return Some(framed.telegram.bytes().to_vec());
                }
                return None;
            }
            match rustix::io::read(&self.port, self.framer.read_buffer()) {
                Ok(0) => return None,
                Ok(count) => self.framer.commit(count),
                Err(Errno::AGAIN | Errno::INTR) => {}
                Err(_) => return None,
            }
        }
    }

    /// Sends `request`, and returns the reply to it. Drops the telegrams before the reply.
    pub(crate) fn ask(&mut self, request: Request) -> Vec<u8> {
        self.write(request);
        loop {
            let telegram = self.telegram(WAIT_TIMEOUT).unwrap_or_else(|| panic!("no reply to {request:?}"));
            if telegram[4] == request.command() | 0x80 {
                return telegram;
            }
        }
    }
}
