//! A serial line behind a serial server on the network, as a plain stream of bytes. Its rate is set in the server and
//! cannot be changed from here. Resolving a name and connecting can block for an unknown time: a separate thread does
//! both, and ends by itself.

use std::io::{self, ErrorKind, PipeReader, PipeWriter};
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;
use std::time::Duration;

use rustix::io::Errno;
use rustix::net::sockopt::{
    set_socket_keepalive, set_tcp_keepcnt, set_tcp_keepidle, set_tcp_keepintvl, set_tcp_nodelay,
    set_tcp_user_timeout,
};
use schema::shortage;

use super::{Port, PortError};

/// A connection to a serial server; reads and writes never block.
pub struct Tcp {
    stream: TcpStream,
}

impl Tcp {
    /// Connects to `port` of `host`, and waits for the outcome, or until `stop` is set.
    pub(crate) fn open(host: &str, port: u16, stop: &AtomicBool) -> Result<Tcp, PortError> {
        let dial = Dial::start(host, port)?;
        for _ in 0..LOOKS {
            match dial.outcome.recv_timeout(LOOK) {
                Ok(outcome) => return outcome,
                Err(_) if stop.load(Ordering::Relaxed) => return Err(PortError::Interrupted),
                Err(_) => {}
            }
        }
        Err(PortError::TimedOut)
    }

    pub(crate) fn read(&self, buffer: &mut [u8]) -> io::Result<usize> {
        match rustix::io::read(&self.stream, buffer) {
            Ok(0) => Err(io::Error::new(ErrorKind::UnexpectedEof, "closed by the serial server")),
            Err(Errno::AGAIN | Errno::INTR) => Ok(0),
            other => Ok(other?),
        }
    }

    /// Discards what arrived.
    pub(crate) fn forget(&self) -> io::Result<()> {
        let mut buffer = [0; 4096];
        // Bounded, for somebody may send as fast as this reads.
        for _ in 0..MOST_FORGOTTEN / buffer.len() {
            if self.read(&mut buffer)? == 0 {
                break;
            }
        }
        Ok(())
    }

    pub(crate) fn write(&self, byte: u8) -> io::Result<()> {
        match rustix::io::write(&self.stream, &[byte]) {
            Ok(_) | Err(Errno::AGAIN | Errno::INTR) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    fn new(stream: TcpStream) -> Result<Tcp, Errno> {
        // The bytes of a request leave one by one, as the sensor wants them.
        set_tcp_nodelay(&stream, true)?;
        // A server that lost its power says nothing; the socket shall notice.
        set_socket_keepalive(&stream, true)?;
        set_tcp_keepidle(&stream, Duration::from_secs(2))?;
        set_tcp_keepintvl(&stream, Duration::from_secs(1))?;
        set_tcp_keepcnt(&stream, 3)?;
        set_tcp_user_timeout(&stream, 5_000)?;
        rustix::io::ioctl_fionbio(&stream, true)?;
        Ok(Tcp { stream })
    }
}

impl AsFd for Tcp {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.stream.as_fd()
    }
}

/// A connection attempt. Its descriptor is ready when the attempt has ended.
pub struct Dial {
    outcome: Receiver<Result<Tcp, PortError>>,
    /// Ready once its other end is gone.
    ready: PipeReader,
}

impl Dial {
    /// Begins.
    pub(crate) fn start(host: &str, port: u16) -> Result<Dial, PortError> {
        let (ready, open_end) = io::pipe().map_err(|error| PortError::of_io(&error))?;
        let (send, outcome) = channel();
        let host = host.to_owned();
        let body = move || tell(connect(&host, port), &send, open_end);
        // A thread is refused by AGAIN.
        let refuse = |error: io::Error| match PortError::of_io(&error) {
            PortError::Other(Errno::AGAIN) => PortError::Short(Errno::AGAIN),
            refusal => refusal,
        };
        thread::Builder::new().name("dial".to_owned()).spawn(body).map_err(refuse)?;
        Ok(Dial { outcome, ready })
    }

    /// The result; a refusal if it has not ended.
    pub fn finish(self) -> Result<Port, PortError> {
        self.outcome.try_recv().unwrap_or(Err(PortError::TimedOut)).map(Port::Tcp)
    }
}

impl AsFd for Dial {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.ready.as_fd()
    }
}

fn tell(outcome: Result<Tcp, PortError>, send: &Sender<Result<Tcp, PortError>>, open_end: PipeWriter) {
    // A caller that gave up waiting does not need the result.
    let _ = send.send(outcome);
    drop(open_end);
}

fn connect(host: &str, port: u16) -> Result<Tcp, PortError> {
    let addresses: Vec<SocketAddr> = match (host, port).to_socket_addrs() {
        Ok(addresses) => addresses.collect(),
        // A look-up that lacks descriptors says that there is no such host.
        Err(_) if shortage::check_descriptors(LOOK_UP).is_err() => {
            return Err(PortError::Short(Errno::MFILE));
        }
        Err(error) => return Err(failed(&error, PortError::NoHost)),
    };
    let mut last = PortError::NoHost("it has no address".to_owned());
    for address in addresses {
        match TcpStream::connect_timeout(&address, CONNECT) {
            Ok(stream) => return Ok(Tcp::new(stream)?),
            Err(error) if error.kind() == ErrorKind::TimedOut => last = PortError::TimedOut,
            Err(error) if error.kind() == ErrorKind::ConnectionRefused => last = PortError::Refused,
            Err(error) => last = failed(&error, PortError::Network),
        }
    }
    Err(last)
}

/// What is short here is neither the network's fault nor the server's, which `otherwise` tells of.
fn failed(error: &io::Error, otherwise: fn(String) -> PortError) -> PortError {
    match PortError::of_io(error) {
        short @ PortError::Short(_) => short,
        _ => otherwise(error.to_string()),
    }
}

/// Descriptors that looking up a name takes at the most: a file, and a socket for each of its servers.
const LOOK_UP: u64 = 4;
/// A serial server in the same house answers sooner.
const CONNECT: Duration = Duration::from_secs(3);
/// Bytes that are thrown away at the most: more than a minute of 500 kBd.
const MOST_FORGOTTEN: usize = 1 << 24;
/// Between two looks whether somebody wants to stop.
const LOOK: Duration = Duration::from_millis(100);
/// Six seconds for name and connection together.
const LOOKS: u32 = 60;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_short_here_is_not_blamed_on_the_network() {
        let of = |errno: Errno| failed(&errno.into(), PortError::Network);
        assert_eq!(of(Errno::MFILE), PortError::Short(Errno::MFILE));
        assert_eq!(of(Errno::NFILE), PortError::Short(Errno::NFILE));
        assert!(matches!(of(Errno::HOSTUNREACH), PortError::Network(_)));
        let unknown = io::Error::other("Name or service not known");
        assert!(matches!(failed(&unknown, PortError::NoHost), PortError::NoHost(_)));
    }
}
