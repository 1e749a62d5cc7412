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
use scanhub_schema::datagram::{Announce, GROUPS, PORT, group};

use super::{Machine, Receiver, read, until};

/// Passes on until it is dropped; nothing is lost, doubled or moved before it is told to.
pub(crate) struct Relay {
    inner: Arc<Mutex<Inner>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

struct Inner {
    /// Sockets to the other machines, and the file in which each lists its UDP sockets.
    out: Vec<(UdpSocket, PathBuf)>,
    /// All that came.
    taken: Vec<Vec<u8>>,
    /// All that was passed on, in this order.
    log: Vec<Vec<u8>>,
    /// What goes out later, and after how many more have come.
    held: Vec<(usize, Vec<u8>)>,
    dice: fastrand::Rng,
    is_rough: bool,
}

/// In percent of what comes.
const LOST: u8 = 5;
const MOVED: u8 = 5;
const DOUBLED: u8 = 2;
/// What is moved goes out after so many others at most: some scans later.
const FARTHEST: usize = 80;

impl Relay {
    /// From the machine `from`.
    pub(crate) fn new(from: &Machine, seed: u64) -> Relay {
        let socket = Receiver::socket(from.here(), PORT);
        let inner = Arc::new(Mutex::new(Inner {
            out: Vec::new(),
            taken: Vec::new(),
            log: Vec::new(),
            held: Vec::new(),
            dice: fastrand::Rng::with_seed(seed),
            is_rough: false,
        }));
        let stop = Arc::new(AtomicBool::new(false));
        let (to, flag) = (inner.clone(), stop.clone());
        let thread = thread::spawn(move || {
            let mut bytes = [0; 65_536];
            while !flag.load(Ordering::Relaxed) {
                if let Ok(len) = socket.recv(&mut bytes) {
                    to.lock().expect("not poisoned").take(&bytes[..len]);
                }
            }
        });
        Relay { inner, stop, thread: Some(thread) }
    }

    /// Passes on to the machine `to` as well from now on; how many were passed on before. Listeners there have to be up.
    pub(crate) fn connect(&self, to: &Machine) -> usize {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).expect("a port");
        set_ip_multicast_if(&socket, &to.here()).expect("the cable is plugged in");
        socket.set_multicast_loop_v4(false).expect("it is IPv4");
        let mut inner = self.inner();
        inner.out.push((socket, to.udp_sockets()));
        inner.log.len()
    }

    /// Lets it lose, move and double, or not any more.
    pub(crate) fn set_rough(&self, is_rough: bool) {
        let mut inner = self.inner();
        inner.is_rough = is_rough;
        if !is_rough {
            inner.let_go(usize::MAX);
        }
    }

    /// What came so far.
    pub(crate) fn taken(&self) -> Vec<Vec<u8>> {
        self.inner().taken.clone()
    }

    /// What was passed on so far.
    pub(crate) fn log(&self) -> Vec<Vec<u8>> {
        self.inner().log.clone()
    }

    fn inner(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().expect("not poisoned")
    }
}

impl Inner {
    fn take(&mut self, datagram: &[u8]) {
        self.taken.push(datagram.to_vec());
        self.let_go(1);
        let fate = if self.is_rough { self.dice.u8(..100) } else { u8::MAX };
        let later = self.dice.usize(1..=FARTHEST);
        if fate < LOST {
            return;
        }
        if fate >= LOST + MOVED {
            self.pass(datagram);
        }
        if fate < LOST + MOVED + DOUBLED {
            self.held.push((later, datagram.to_vec()));
        }
    }

    /// So many more have come.
    fn let_go(&mut self, more: usize) {
        for (left, datagram) in std::mem::take(&mut self.held) {
            match left.checked_sub(more).filter(|left| *left > 0) {
                Some(left) => self.held.push((left, datagram)),
                None => self.pass(&datagram),
            }
        }
    }

    fn pass(&mut self, datagram: &[u8]) {
        let topic = Topic::of_number(read(datagram).head.topic);
        let [a, b, c] = GROUPS;
        let group = Ipv4Addr::new(a, b, c, topic.map_or(Announce::GROUP, group));
        for (out, sockets) in &self.out {
            until("listeners read", || most_waiting(sockets) < MOST_WAITING);
            let sent = out.send_to(datagram, (group, PORT));
            assert_eq!(sent.expect("the cable takes it"), datagram.len());
        }
        self.log.push(datagram.to_vec());
    }
}

/// Bytes that may wait at a socket before the relay waits: a fraction of the smallest receive buffer that a listener has.
const MOST_WAITING: u64 = 64 << 10;

/// Bytes that wait at the fullest of the UDP sockets that the file `sockets` lists (proc(5), `rx_queue`).
fn most_waiting(sockets: &Path) -> u64 {
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
