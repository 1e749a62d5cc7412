//! A relay between two machines: takes what one sends and passes it on to others, not all of it, not in its order, and some
//! of it twice. It waits while the receive buffer of a machine fills up, so that the kernel drops nothing when a listener does
//! not get a processor. Its log is therefore the truth about what the others received.

use std::net::{Ipv4Addr, UdpSocket};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::{self, JoinHandle};

use rustix::net::sockopt::set_ip_multicast_if;
use scanhub_schema::Topic;
use scanhub_schema::datagram::{Announce, GROUP_PREFIX, PORT, group};

use super::{Machine, Receiver, decode_datagram, wait_until};

/// Passes on until it is dropped; nothing is lost, doubled or moved before it is told to.
pub(crate) struct Relay {
    inner: Arc<Mutex<RelayState>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

struct RelayState {
    /// Sockets to the other machines, and the file in which each lists its UDP sockets.
    outputs: Vec<(UdpSocket, PathBuf)>,
    /// All that came.
    received: Vec<Vec<u8>>,
    /// All that was passed on, in this order.
    forwarded: Vec<Vec<u8>>,
    /// What goes out later, and after how many more have come.
    delayed: Vec<(usize, Vec<u8>)>,
    rng: fastrand::Rng,
    is_faulty: bool,
}

/// In percent of what comes.
const LOSS_PERCENT: u8 = 5;
const DELAY_PERCENT: u8 = 5;
const DUPLICATE_PERCENT: u8 = 2;
/// What is moved goes out after so many others at most: some scans later.
const MAX_DELAY_DATAGRAMS: usize = 80;

impl Relay {
    /// From the machine `from`.
    pub(crate) fn new(from: &Machine, seed: u64) -> Relay {
        let socket = Receiver::socket(from.test_address(), PORT);
        let inner = Arc::new(Mutex::new(RelayState {
            outputs: Vec::new(),
            received: Vec::new(),
            forwarded: Vec::new(),
            delayed: Vec::new(),
            rng: fastrand::Rng::with_seed(seed),
            is_faulty: false,
        }));
        let stop = Arc::new(AtomicBool::new(false));
        let (to, flag) = (inner.clone(), stop.clone());
        let thread = thread::spawn(move || {
            let mut bytes = [0; 65_536];
            while !flag.load(Ordering::Relaxed) {
                if let Ok(len) = socket.recv(&mut bytes) {
                    to.lock().expect("not poisoned").receive(&bytes[..len]);
                }
            }
        });
        Relay { inner, stop, thread: Some(thread) }
    }

    /// Passes on to the machine `to` as well from now on; how many were passed on before. Listeners there have to be up.
    pub(crate) fn connect(&self, to: &Machine) -> usize {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).expect("a port");
        set_ip_multicast_if(&socket, &to.test_address()).expect("the cable is plugged in");
        socket.set_multicast_loop_v4(false).expect("it is IPv4");
        let mut inner = self.state();
        inner.outputs.push((socket, to.udp_sockets()));
        inner.forwarded.len()
    }

    /// Lets it lose, move and double, or not any more.
    pub(crate) fn set_faulty(&self, is_faulty: bool) {
        let mut inner = self.state();
        inner.is_faulty = is_faulty;
        if !is_faulty {
            inner.send_delayed(usize::MAX);
        }
    }

    /// What came so far.
    pub(crate) fn received(&self) -> Vec<Vec<u8>> {
        self.state().received.clone()
    }

    /// What was passed on so far.
    pub(crate) fn forwarded(&self) -> Vec<Vec<u8>> {
        self.state().forwarded.clone()
    }

    fn state(&self) -> MutexGuard<'_, RelayState> {
        self.inner.lock().expect("not poisoned")
    }
}

impl RelayState {
    fn receive(&mut self, datagram: &[u8]) {
        self.received.push(datagram.to_vec());
        self.send_delayed(1);
        let fate = if self.is_faulty { self.rng.u8(..100) } else { u8::MAX };
        let later = self.rng.usize(1..=MAX_DELAY_DATAGRAMS);
        if fate < LOSS_PERCENT {
            return;
        }
        if fate >= LOSS_PERCENT + DELAY_PERCENT {
            self.forward(datagram);
        }
        if fate < LOSS_PERCENT + DELAY_PERCENT + DUPLICATE_PERCENT {
            self.delayed.push((later, datagram.to_vec()));
        }
    }

    /// So many more have come.
    fn send_delayed(&mut self, arrived: usize) {
        for (left, datagram) in std::mem::take(&mut self.delayed) {
            match left.checked_sub(arrived).filter(|left| *left > 0) {
                Some(left) => self.delayed.push((left, datagram)),
                None => self.forward(&datagram),
            }
        }
    }

    fn forward(&mut self, datagram: &[u8]) {
        let topic = Topic::of_number(decode_datagram(datagram).head.topic);
        let [a, b, c] = GROUP_PREFIX;
        let group = Ipv4Addr::new(a, b, c, topic.map_or(Announce::GROUP, group));
        for (out, sockets) in &self.outputs {
            wait_until("listeners read", || max_queued_bytes(sockets) < MAX_QUEUED_BYTES);
            let sent = out.send_to(datagram, (group, PORT));
            assert_eq!(sent.expect("the cable takes it"), datagram.len());
        }
        self.forwarded.push(datagram.to_vec());
    }
}

/// Bytes that may wait at a socket before the relay waits: a fraction of the smallest receive buffer that a listener has.
const MAX_QUEUED_BYTES: u64 = 64 << 10;

/// Bytes that wait at the fullest of the UDP sockets that the file `sockets` lists (proc(5), `rx_queue`).
fn max_queued_bytes(sockets: &Path) -> u64 {
    let text = std::fs::read_to_string(sockets).expect("the machine is there");
    let waiting = |line: &str| {
        let queues = line.split_whitespace().nth(4)?;
        u64::from_str_radix(queues.split_once(':')?.1, 16).ok()
    };
    text.lines().filter_map(waiting).max().unwrap_or(0)
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let ended = self.thread.take().is_none_or(|thread| thread.join().is_ok());
        assert!(ended || thread::panicking(), "the relay panicked");
    }
}
