//! Receiver for the datagrams of gateways in a network.

use std::net::{Ipv4Addr, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use rustix::net::sockopt::set_socket_recv_buffer_size_force;
use scanhub_schema::datagram::{Datagram, GROUP_PREFIX, PORT};

use super::wait_until;

/// Thread that stores all datagrams that arrive at a port, both unicast and from the four multicast groups.
pub(crate) struct Receiver {
    datagrams: Arc<Mutex<Vec<Vec<u8>>>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Receiver {
    /// Creates a receiver on the interface with this address, at the default port of the groups.
    pub(crate) fn new(interface: Ipv4Addr) -> Receiver {
        Receiver::at(interface, PORT)
    }

    /// Creates a receiver on the interface with this address, at `port`.
    pub(crate) fn at(interface: Ipv4Addr, port: u16) -> Receiver {
        let socket = Receiver::socket(interface, port);
        let (datagrams, stop) = (Arc::new(Mutex::new(Vec::new())), Arc::new(AtomicBool::new(false)));
        let (to, flag) = (datagrams.clone(), stop.clone());
        let thread = thread::spawn(move || {
            let mut bytes = [0; 65_536];
            let mut is_over = false;
            loop {
                match socket.recv(&mut bytes) {
                    Ok(len) => to.lock().expect("no thread has panicked").push(bytes[..len].to_vec()),
                    Err(_) if is_over => return,
                    Err(_) => {}
                }
                // Store the datagrams that have already arrived when the thread is stopped, but do not wait for more.
                if !is_over && flag.load(Ordering::Relaxed) {
                    is_over = true;
                    socket.set_nonblocking(true).expect("the socket can be made nonblocking");
                }
            }
        });
        Receiver { datagrams, stop, thread: Some(thread) }
    }

    /// Creates a socket at `port` that has joined the four groups on the interface with this address. Its read timeout
    /// is 50 ms.
    pub(crate) fn socket(interface: Ipv4Addr, port: u16) -> UdpSocket {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, port)).expect("the port is free");
        for last in 80..84 {
            let group = Ipv4Addr::new(GROUP_PREFIX[0], GROUP_PREFIX[1], GROUP_PREFIX[2], last);
            socket.join_multicast_v4(&group, &interface).expect("the group can be joined");
        }
        // This buffer is large enough for the datagrams of a second in which the test is not scheduled. A user without
        // the privilege for this size may miss datagrams.
        let _ = set_socket_recv_buffer_size_force(&socket, 8 << 20);
        socket.set_read_timeout(Some(Duration::from_millis(50))).expect("the read timeout can be set");
        socket
    }

    /// Returns all datagrams received so far, in order.
    pub(crate) fn datagrams(&self) -> Vec<Vec<u8>> {
        self.datagrams.lock().expect("no thread has panicked").clone()
    }

    /// Waits until `count` datagrams that `is_expected` accepts have arrived after this call. Panics if any new
    /// datagram is invalid.
    pub(crate) fn wait_for_datagrams(&self, count: usize, is_expected: impl Fn(&Datagram<'_>) -> bool) {
        let before = self.datagrams().len();
        wait_until("the expected datagrams arrive", || {
            let datagrams = self.datagrams();
            datagrams[before..].iter().filter(|bytes| is_expected(&decode_datagram(bytes))).count() >= count
        });
    }

    /// Receives the datagrams that are still queued at the socket, stops, and returns all datagrams in order.
    pub(crate) fn finish(mut self) -> Vec<Vec<u8>> {
        self.stop_thread();
        self.datagrams()
    }

    fn stop_thread(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let ended = self.thread.take().is_none_or(|thread| thread.join().is_ok());
        assert!(ended || thread::panicking(), "the thread of the receiver panicked");
    }
}

impl Drop for Receiver {
    fn drop(&mut self) {
        self.stop_thread();
    }
}

/// Decodes the datagram in `bytes` and checks its payload.
///
/// # Panics
///
/// Panics if the header or the payload is invalid.
pub(crate) fn decode_datagram(bytes: &[u8]) -> Datagram<'_> {
    let datagram = Datagram::read(bytes).unwrap_or_else(|refusal| panic!("{refusal:?}: {bytes:02x?}"));
    datagram.check_payload().unwrap_or_else(|refusal| panic!("{refusal:?}: {bytes:02x?}"));
    datagram
}
