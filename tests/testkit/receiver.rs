//! Who listens on a network, and knows nothing of who sends.

use std::net::{Ipv4Addr, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use rustix::net::sockopt::set_socket_recv_buffer_size_force;
use scanhub_schema::datagram::{Datagram, GROUP_PREFIX, PORT};

use super::wait_until;

/// Takes all datagrams that come to a port, from the four groups and from elsewhere.
pub(crate) struct Receiver {
    datagrams: Arc<Mutex<Vec<Vec<u8>>>>,
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
        let (datagrams, stop) = (Arc::new(Mutex::new(Vec::new())), Arc::new(AtomicBool::new(false)));
        let (to, flag) = (datagrams.clone(), stop.clone());
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
        Receiver { datagrams, stop, thread: Some(thread) }
    }

    /// Hears the four groups on this interface, at this port; waits 50 ms for a datagram.
    pub(crate) fn socket(interface: Ipv4Addr, port: u16) -> UdpSocket {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, port)).expect("the port is free");
        for last in 80..84 {
            let group = Ipv4Addr::new(GROUP_PREFIX[0], GROUP_PREFIX[1], GROUP_PREFIX[2], last);
            socket.join_multicast_v4(&group, &interface).expect("the group can be joined");
        }
        // A test that is not scheduled for a second shall miss nothing; where that is not allowed it may.
        let _ = set_socket_recv_buffer_size_force(&socket, 8 << 20);
        socket.set_read_timeout(Some(Duration::from_millis(50))).expect("waits that long");
        socket
    }

    /// All that came so far, in its order.
    pub(crate) fn datagrams(&self) -> Vec<Vec<u8>> {
        self.datagrams.lock().expect("not poisoned").clone()
    }

    /// Waits until so many datagrams were `is_expected` from now on; each is whole and says what its topic says.
    pub(crate) fn wait_for_datagrams(&self, count: usize, is_expected: impl Fn(&Datagram<'_>) -> bool) {
        let before = self.datagrams().len();
        wait_until("datagrams", || {
            let datagrams = self.datagrams();
            datagrams[before..].iter().filter(|bytes| is_expected(&decode_datagram(bytes))).count() >= count
        });
    }

    /// Takes what still waits, and all of it.
    pub(crate) fn finish(mut self) -> Vec<Vec<u8>> {
        self.stop_thread();
        self.datagrams()
    }

    fn stop_thread(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let ended = self.thread.take().is_none_or(|thread| thread.join().is_ok());
        assert!(ended || thread::panicking(), "the receiver panicked");
    }
}

impl Drop for Receiver {
    fn drop(&mut self) {
        self.stop_thread();
    }
}

/// The datagram in `bytes`, which is in order.
pub(crate) fn decode_datagram(bytes: &[u8]) -> Datagram<'_> {
    let datagram = Datagram::read(bytes).unwrap_or_else(|refusal| panic!("{refusal:?}: {bytes:02x?}"));
    datagram.check_payload().unwrap_or_else(|refusal| panic!("{refusal:?}: {bytes:02x?}"));
    datagram
}
