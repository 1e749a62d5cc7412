//! Who listens on a network, and knows nothing of who sends.

use std::net::{Ipv4Addr, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use rustix::net::sockopt::set_socket_recv_buffer_size_force;
use scanhub_schema::datagram::{Datagram, GROUPS, PORT};

use super::until;

/// Takes all datagrams that come to a port, from the four groups and from elsewhere.
pub(crate) struct Receiver {
    heard: Arc<Mutex<Vec<Vec<u8>>>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Receiver {
    /// On the interface with this address, at the port of the groups.
    pub(crate) fn new(interface: Ipv4Addr) -> Receiver {
        Receiver::at(interface, PORT)
    }

    /// At another port.
    pub(crate) fn at(interface: Ipv4Addr, port: u16) -> Receiver {
        let socket = Receiver::socket(interface, port);
        let (heard, stop) = (Arc::new(Mutex::new(Vec::new())), Arc::new(AtomicBool::new(false)));
        let (to, flag) = (heard.clone(), stop.clone());
        let thread = thread::spawn(move || {
            let mut bytes = [0; 65_536];
            let mut is_over = false;
            loop {
                match socket.recv(&mut bytes) {
                    Ok(len) => to.lock().expect("not poisoned").push(bytes[..len].to_vec()),
                    Err(_) if is_over => return,
                    Err(_) => {}
                }
                // What waits when it is told to stop is taken, what comes later is not waited for.
                if !is_over && flag.load(Ordering::Relaxed) {
                    is_over = true;
                    socket.set_nonblocking(true).expect("need not wait");
                }
            }
        });
        Receiver { heard, stop, thread: Some(thread) }
    }

    /// Hears the four groups on this interface, at this port; waits 50 ms for a datagram.
    pub(crate) fn socket(interface: Ipv4Addr, port: u16) -> UdpSocket {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, port)).expect("the port is free");
        for last in 80..84 {
            let group = Ipv4Addr::new(GROUPS[0], GROUPS[1], GROUPS[2], last);
            socket.join_multicast_v4(&group, &interface).expect("the group can be joined");
        }
        // A test that is not scheduled for a second shall miss nothing; where that is not allowed it may.
        let _ = set_socket_recv_buffer_size_force(&socket, 8 << 20);
        socket.set_read_timeout(Some(Duration::from_millis(50))).expect("waits that long");
        socket
    }

    /// All that came so far, in its order.
    pub(crate) fn heard(&self) -> Vec<Vec<u8>> {
        self.heard.lock().expect("not poisoned").clone()
    }

    /// Waits until so many datagrams were `wanted` from now on; each is whole and says what its topic says.
    pub(crate) fn await_more(&self, count: usize, wanted: impl Fn(&Datagram<'_>) -> bool) {
        let before = self.heard().len();
        until("datagrams", || {
            let heard = self.heard();
            heard[before..].iter().filter(|bytes| wanted(&read(bytes))).count() >= count
        });
    }

    /// Takes what still waits, and all of it.
    pub(crate) fn finish(mut self) -> Vec<Vec<u8>> {
        self.end();
        self.heard()
    }

    fn end(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let ended = self.thread.take().is_none_or(|thread| thread.join().is_ok());
        assert!(ended || thread::panicking(), "the receiver panicked");
    }
}

impl Drop for Receiver {
    fn drop(&mut self) {
        self.end();
    }
}

/// The datagram in `bytes`, which is in order.
pub(crate) fn read(bytes: &[u8]) -> Datagram<'_> {
    let datagram = Datagram::read(bytes).unwrap_or_else(|refusal| panic!("{refusal:?}: {bytes:02x?}"));
    datagram.check_payload().unwrap_or_else(|refusal| panic!("{refusal:?}: {bytes:02x?}"));
    datagram
}
