//! Relay for datagrams between machines. It can drop, delay and duplicate datagrams at random.
//!
//! The relay waits while the receive buffer of a machine is filling up, so that the kernel drops no datagram while a
//! listener is not scheduled. The datagrams in `forwarded` are therefore exactly those that the machines receive.

use std::net::{Ipv4Addr, UdpSocket};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::{self, JoinHandle};

use rustix::net::sockopt::set_ip_multicast_if;
use scanhub_schema::Topic;
use scanhub_schema::datagram::{Announce, GROUP_PREFIX, PORT, group};

use super::{Machine, Receiver, decode_datagram, wait_until};

/// Thread that forwards datagrams until this value is dropped. It forwards each datagram once and in order until
/// [`Relay::set_faulty`] is called.
pub(crate) struct Relay {
    inner: Arc<Mutex<RelayState>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

struct RelayState {
    /// Sockets to the other machines, each with the path of the file that lists the machine's UDP sockets.
    outputs: Vec<(UdpSocket, PathBuf)>,
    /// All datagrams that have arrived, in order.
    received: Vec<Vec<u8>>,
    /// All datagrams that were forwarded, in the order in which they were sent.
    forwarded: Vec<Vec<u8>>,
    /// Datagrams that are forwarded later. The number is the count of datagrams that must arrive before this one is
    /// forwarded.
    delayed: Vec<(usize, Vec<u8>)>,
    rng: fastrand::Rng,
    is_faulty: bool,
}

/// Percentage of the arriving datagrams that are dropped.
const LOSS_PERCENT: u8 = 5;
/// Percentage of the arriving datagrams that are forwarded only later.
const DELAY_PERCENT: u8 = 5;
/// Percentage of the arriving datagrams that are forwarded at once and again later.
const DUPLICATE_PERCENT: u8 = 2;
/// Maximum delay of a datagram, as the number of datagrams that arrive during the delay. 80 datagrams correspond to
/// several scans.
const MAX_DELAY_DATAGRAMS: usize = 80;

impl Relay {
    /// Starts a relay for the datagrams that the machine `from` sends. `seed` is the seed of the random numbers that
    /// decide which datagrams get a fault.
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
                    to.lock().expect("no thread has panicked").receive(&bytes[..len]);
                }
            }
        });
        Relay { inner, stop, thread: Some(thread) }
    }

    /// Adds the machine `to` to those that receive the forwarded datagrams. Returns the number of datagrams that were
    /// forwarded before. Listeners on `to` must have started already.
    pub(crate) fn connect(&self, to: &Machine) -> usize {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).expect("a UDP port is free");
        set_ip_multicast_if(&socket, &to.test_address()).expect("the interface of the cable exists");
        socket.set_multicast_loop_v4(false).expect("multicast loopback can be disabled");
        let mut inner = self.state();
        inner.outputs.push((socket, to.udp_sockets()));
        inner.forwarded.len()
    }

    /// Sets whether datagrams are dropped, delayed and duplicated. If `is_faulty` is false, forwards all delayed
    /// datagrams at once.
    pub(crate) fn set_faulty(&self, is_faulty: bool) {
        let mut inner = self.state();
        inner.is_faulty = is_faulty;
        if !is_faulty {
            inner.send_delayed(usize::MAX);
        }
    }

    /// Returns the datagrams that have arrived so far, in order.
    pub(crate) fn received(&self) -> Vec<Vec<u8>> {
        self.state().received.clone()
    }

    /// Returns the datagrams that were forwarded so far, in the order in which they were sent.
    pub(crate) fn forwarded(&self) -> Vec<Vec<u8>> {
        self.state().forwarded.clone()
    }

    fn state(&self) -> MutexGuard<'_, RelayState> {
        self.inner.lock().expect("no thread has panicked")
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

    /// Forwards the delayed datagrams that are due after `arrived` more datagrams have arrived.
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
            wait_until("the listeners read their sockets", || max_queued_bytes(sockets) < MAX_QUEUED_BYTES);
            let sent = out.send_to(datagram, (group, PORT));
            assert_eq!(sent.expect("the datagram can be sent"), datagram.len());
        }
        self.forwarded.push(datagram.to_vec());
    }
}

/// Number of bytes in a socket's receive buffer at which the relay starts to wait. It is a fraction of the smallest
/// receive buffer of a listener.
const MAX_QUEUED_BYTES: u64 = 64 << 10;

/// Returns the largest number of bytes that are queued at one of the UDP sockets in the file `sockets` (proc(5),
/// `rx_queue`).
fn max_queued_bytes(sockets: &Path) -> u64 {
    let text = std::fs::read_to_string(sockets).expect("the process of the machine runs");
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
        assert!(ended || thread::panicking(), "the thread of the relay panicked");
    }
}
