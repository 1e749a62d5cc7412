//! A long, slow way between a listener and who connects: so many bytes a second, each after the same time, in both directions,
//! and no more under way than that needs. (Kernels with netem and tbf do the same to a network of their own.)

use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::thread;
use std::time::{Duration, Instant};

use socket2::{Domain, Protocol, Socket, Type};

/// Bytes that the sockets of the way hold at either end.
const SOCKET: usize = 4096;
/// What goes at once, in bytes: what a packet of a network holds, not one of the loopback.
const PACKET: usize = 1448;

/// Passes on between who connects to the returned address and who listens at `to`.
pub(crate) fn relay(to: SocketAddr, bytes_a_second: f64, delay: Duration) -> SocketAddr {
    let listener = socket();
    listener.bind(&SocketAddr::from(([127, 0, 0, 1], 0)).into()).expect("a port");
    listener.listen(8).expect("it is bound");
    let listener = TcpListener::from(listener);
    let at = listener.local_addr().expect("it is bound");
    // It ends with the bench.
    thread::spawn(move || {
        for near in listener.incoming().map_while(Result::ok) {
            let far = socket();
            if far.connect(&to.into()).is_err() {
                // Nobody listens any more.
                continue;
            }
            let far = TcpStream::from(far);
            near.set_nodelay(true).expect("TCP");
            for (from, to) in [(&near, &far), (&far, &near)] {
                let both = [from, to].map(|stream| stream.try_clone().expect("a descriptor"));
                thread::spawn(move || pass(both, bytes_a_second, delay));
            }
        }
    });
    at
}

/// One end of the way, with the packets and the room of a network.
fn socket() -> Socket {
    let socket = Socket::new(Domain::IPV4, Type::STREAM, Some(Protocol::TCP)).expect("a socket");
    socket.set_tcp_mss(PACKET as u32).expect("a size");
    socket.set_recv_buffer_size(SOCKET).expect("a size");
    socket.set_send_buffer_size(SOCKET).expect("a size");
    socket.set_tcp_nodelay(true).expect("TCP");
    socket
}

fn pass([mut from, mut to]: [TcpStream; 2], bytes_a_second: f64, delay: Duration) {
    let mut under_way: VecDeque<(Instant, Vec<u8>)> = VecDeque::new();
    let mut room_at = Instant::now();
    let mut packet = [0; PACKET];
    loop {
        let now = Instant::now();
        while under_way.front().is_some_and(|(at, _)| *at <= now)
            && let Some((_, bytes)) = under_way.pop_front()
        {
            if to.write_all(&bytes).is_err() {
                return;
            }
        }
        let next = under_way.front().map_or(now + delay, |(at, _)| *at);
        if room_at > now {
            thread::sleep(room_at.min(next).saturating_duration_since(now));
            continue;
        }
        let wait = next.saturating_duration_since(now).max(Duration::from_millis(1));
        from.set_read_timeout(Some(wait)).expect("a time");
        match from.read(&mut packet) {
            // What is under way arrives all the same.
            Ok(0) => {
                for (at, bytes) in under_way {
                    thread::sleep(at.saturating_duration_since(Instant::now()));
                    let _ = to.write_all(&bytes);
                }
                let _ = to.shutdown(Shutdown::Write);
                return;
            }
            Ok(len) => {
                room_at = Instant::now().max(room_at) + Duration::from_secs_f64(len as f64 / bytes_a_second);
                under_way.push_back((room_at + delay, packet[..len].to_vec()));
            }
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
            Err(_) => return,
        }
    }
}
