//! Connection to a serial server on the network, which delivers the bytes of a serial line. The baud rate is set in the
//! server and cannot be changed from here. Resolving a name and connecting can block for an unknown time, so a separate
//! thread does both. No caller waits for the end of the thread.
//!
//! A connection can deliver bytes faster than any line. The read budget allows twice the rate of the line. The budget
//! allows up to one second of bytes at once, because a network delays data and then catches up. Bytes beyond the budget
//! stay in the connection. When they are read, they are older than they seem.

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
use scanhub_schema::{MILLIS, Nanos, line_time};
use scanhub_shm::resource_limits;

use crate::{Port, PortError, write_all};

/// Connection to a serial server. Reads and writes never block.
pub struct Tcp {
    stream: TcpStream,
}

impl Tcp {
    /// Connects to `port` of `host`. Waits for the result, or until `stop` is set.
    pub(crate) fn open(host: &str, port: u16, stop: &AtomicBool) -> Result<Tcp, PortError> {
        let pending = PendingConnection::start(host, port)?;
        for _ in 0..MAX_POLLS {
            match pending.outcome.recv_timeout(POLL_INTERVAL) {
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

    /// Discards the received bytes.
    pub(crate) fn discard_input(&self) -> io::Result<()> {
        let mut buffer = [0; 4096];
        // Limit the number of bytes, because the server may send as fast as this loop reads.
        for _ in 0..MAX_DISCARDED / buffer.len() {
            if self.read(&mut buffer)? == 0 {
                break;
            }
        }
        Ok(())
    }

    pub(crate) fn write(&self, bytes: &[u8]) -> io::Result<()> {
        Ok(write_all(&self.stream, bytes)?)
    }

    fn new(stream: TcpStream) -> Result<Tcp, Errno> {
        // Requests are sent byte by byte, as the scanner requires.
        set_tcp_nodelay(&stream, true)?;
        // A server that has lost power sends nothing. With keepalive, the socket then reports an error.
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

/// Connection attempt in progress. Its descriptor becomes ready when the attempt ends.
pub struct PendingConnection {
    outcome: Receiver<Result<Tcp, PortError>>,
    /// Pipe that becomes readable when the thread drops the other end.
    ready: PipeReader,
}

impl PendingConnection {
    /// Starts an attempt to connect to `port` of `host`.
    pub(crate) fn start(host: &str, port: u16) -> Result<PendingConnection, PortError> {
        let (ready, open_end) = io::pipe().map_err(|error| PortError::of_io(&error))?;
        let (send, outcome) = channel();
        let host = host.to_owned();
        let body = move || send_outcome(connect(&host, port), &send, open_end);
        // The kernel reports AGAIN if it cannot create a thread.
        let thread_error = |error: io::Error| match PortError::of_io(&error) {
            PortError::Other(Errno::AGAIN) => PortError::ResourceExhausted(Errno::AGAIN),
            error => error,
        };
        thread::Builder::new().name("dial".to_owned()).spawn(body).map_err(thread_error)?;
        Ok(PendingConnection { outcome, ready })
    }

    /// Returns the result. Returns an error if the attempt has not ended.
    pub fn finish(self) -> Result<Port, PortError> {
        self.outcome.try_recv().unwrap_or(Err(PortError::TimedOut)).map(Port::Tcp)
    }
}

impl AsFd for PendingConnection {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.ready.as_fd()
    }
}

fn send_outcome(
    outcome: Result<Tcp, PortError>,
    send: &Sender<Result<Tcp, PortError>>,
    open_end: PipeWriter,
) {
    // A caller that has stopped waiting does not need the result.
    let _ = send.send(outcome);
    drop(open_end);
}

fn connect(host: &str, port: u16) -> Result<Tcp, PortError> {
    let addresses: Vec<SocketAddr> = match (host, port).to_socket_addrs() {
        Ok(addresses) => addresses.collect(),
        // If descriptors run out, the lookup reports that the host does not exist.
        Err(_) if resource_limits::check_descriptors(LOOKUP_DESCRIPTORS).is_err() => {
            return Err(PortError::ResourceExhausted(Errno::MFILE));
        }
        Err(error) => return Err(connection_error(&error, PortError::NoHost)),
    };
    let mut last = PortError::NoHost("it has no address".to_owned());
    for address in addresses {
        match TcpStream::connect_timeout(&address, CONNECT_TIMEOUT) {
            Ok(stream) => return Ok(Tcp::new(stream)?),
            Err(error) if error.kind() == ErrorKind::TimedOut => last = PortError::TimedOut,
            Err(error) if error.kind() == ErrorKind::ConnectionRefused => last = PortError::Refused,
            Err(error) => last = connection_error(&error, PortError::Network),
        }
    }
    Err(last)
}

/// Returns the reason for `error`. If this machine has run out of a resource, neither the network nor the server is the
/// cause. In all other cases, `otherwise` returns the reason.
fn connection_error(error: &io::Error, otherwise: fn(String) -> PortError) -> PortError {
    match PortError::of_io(error) {
        short @ PortError::ResourceExhausted(_) => short,
        _ => otherwise(error.to_string()),
    }
}

/// Maximum number of descriptors that a name lookup needs: one for a file, and one for a socket to each name server.
const LOOKUP_DESCRIPTORS: u64 = 4;
/// Timeout of a connection. A serial server in the same building replies sooner.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);
/// Maximum number of bytes to discard. A line at 500 kBd carries fewer in a minute.
const MAX_DISCARDED: usize = 1 << 24;
/// Interval between checks of `stop`.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Maximum number of checks, one every 100 ms. Name lookup and connection together may therefore take six seconds.
const MAX_POLLS: u32 = 60;

/// Read budget of a network port. It grows with time, and reading consumes it. The caller passes the time.
#[derive(Clone, Debug)]
pub struct ReadBudget {
    /// Cost of a byte, in nanoseconds.
    byte_ns: Nanos,
    /// Time until which the budget is consumed.
    spent_until: Nanos,
    /// First and last time at which the budget was exhausted, in the current period of exhaustion.
    exhausted: Option<(Nanos, Nanos)>,
    /// Whether the last read filled its buffer, so that more bytes may be available.
    has_more: bool,
}

impl ReadBudget {
    /// Creates a full budget at `now`, for a line of `baud` bits per second.
    pub fn new(baud: u32, now: Nanos) -> ReadBudget {
        let byte_ns = line_time(1, baud) / BUDGET_FACTOR;
        ReadBudget { byte_ns, spent_until: now.saturating_sub(MAX_BURST), exhausted: None, has_more: false }
    }

    /// Returns the number of bytes that may be read at `now`.
    pub fn bytes(&self, now: Nanos) -> usize {
        (now.saturating_sub(self.unspent_since(now)) / self.byte_ns) as usize
    }

    /// Records a read of `len` bytes at `now` into a buffer of `buffer_len` bytes.
    pub fn record_read(&mut self, len: usize, buffer_len: usize, now: Nanos) {
        self.has_more = len > 0 && len == buffer_len;
        self.spent_until = self.unspent_since(now) + len as Nanos * self.byte_ns;
    }

    /// Returns the time at which the caller may read again, if the budget at `now` is too small for an efficient read.
    /// Until this time, the caller must not wait for bytes. `until` is the next deadline of the caller. At this
    /// deadline, the caller may read even a single byte.
    pub fn throttled_until(&mut self, now: Nanos, until: Nanos) -> Option<Nanos> {
        let (byte_at, resume_at) = (self.spent_until + self.byte_ns, self.spent_until + MIN_REFILL);
        if now >= resume_at {
            return None;
        }
        let since =
            self.exhausted.filter(|&(_, last)| now < last + RECOVERY_TIME).map_or(now, |(since, _)| since);
        self.exhausted = Some((since, now));
        // The caller handles an overdue deadline only after it has read all available bytes. More bytes are available,
        // so such a deadline does not shorten the wait.
        Some(if until > now { until.clamp(byte_at, resume_at) } else { resume_at })
    }

    /// Returns whether, at `now`, the connection has already delivered more bytes than the budget allows for a while.
    pub fn is_flooded(&self, now: Nanos) -> bool {
        self.exhausted
            .is_some_and(|(since, last)| now < last + RECOVERY_TIME && last >= since + FLOOD_THRESHOLD)
    }

    /// Returns whether, at `now`, the bytes of the last read may have been buffered in the connection. This is so if,
    /// at the last read or shortly before, the connection had more bytes than the caller could read.
    pub fn is_backlogged(&self, now: Nanos) -> bool {
        self.has_more || self.exhausted.is_some_and(|(_, last)| now < last + SETTLE_TIME)
    }

    /// Returns the time from which the budget is unspent. Budget older than [`MAX_BURST`] has expired.
    fn unspent_since(&self, now: Nanos) -> Nanos {
        self.spent_until.max(now.saturating_sub(MAX_BURST))
    }
}

/// Factor between the read budget and the rate of the line.
const BUDGET_FACTOR: Nanos = 2;
/// Maximum time for which unspent budget accumulates.
const MAX_BURST: Nanos = 1_000 * MILLIS;
/// Time for which the caller lets the budget grow after the budget was exhausted, so that the next read is efficient.
const MIN_REFILL: Nanos = 20 * MILLIS;
/// Minimum duration of a flood. Bytes that a network has delayed are usually read within a second.
const FLOOD_THRESHOLD: Nanos = 1_500 * MILLIS;
/// Time without exhaustion after which bytes count as new. A network that catches up delivers its bytes in bursts.
const SETTLE_TIME: Nanos = 200 * MILLIS;
/// Time without exhaustion after which the period of exhaustion ends.
const RECOVERY_TIME: Nanos = 5_000 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn local_exhaustion_is_not_a_network_error() {
        let of = |errno: Errno| connection_error(&errno.into(), PortError::Network);
        assert_eq!(of(Errno::MFILE), PortError::ResourceExhausted(Errno::MFILE));
        assert_eq!(of(Errno::NFILE), PortError::ResourceExhausted(Errno::NFILE));
        assert!(matches!(of(Errno::HOSTUNREACH), PortError::Network(_)));
        let unknown = io::Error::other("Name or service not known");
        assert!(matches!(connection_error(&unknown, PortError::NoHost), PortError::NoHost(_)));
    }

    const BAUD: u32 = 500_000;
    const SECOND: Nanos = 1_000 * MILLIS;

    /// Reads from `begin` to `end` from a connection that always has more bytes. Returns the number of bytes and of
    /// reads.
    fn flooded(allowance: &mut ReadBudget, begin: Nanos, end: Nanos) -> (usize, u32) {
        let (mut now, mut read, mut reads) = (begin, 0, 0);
        while now < end {
            match allowance.throttled_until(now, Nanos::MAX) {
                Some(until) => now = until,
                None => {
                    let len = allowance.bytes(now).min(900);
                    allowance.record_read(len, len, now);
                    (read, reads) = (read + len, reads + 1);
                    now += 1;
                }
            }
        }
        (read, reads)
    }

    #[test]
    fn read_budget_allows_twice_the_line_rate() {
        for baud in [500_000, 38_400, 9_600] {
            let mut allowance = ReadBudget::new(baud, 9 * SECOND);
            let second = baud as usize / 10 * 2;
            let (read, _) = flooded(&mut allowance, 9 * SECOND, 10 * SECOND);
            assert!((2 * second - second / 40..=2 * second).contains(&read), "{baud}: {read}");
            let (read, reads) = flooded(&mut allowance, 10 * SECOND, 20 * SECOND);
            assert!(
                (10 * second - second / 40..=10 * second + second / 40).contains(&read),
                "{baud}: {read}"
            );
            assert!(reads <= 2_000, "{baud}: {reads}");
            assert!(allowance.is_flooded(20 * SECOND) && !allowance.is_flooded(30 * SECOND));
            // A pause refills the budget, up to one second.
            assert_eq!(allowance.bytes(90 * SECOND), second);
        }
    }

    #[test]
    fn normal_line_is_never_throttled() {
        let mut allowance = ReadBudget::new(BAUD, SECOND);
        for now in (SECOND..60 * SECOND).step_by(MILLIS as usize) {
            assert_eq!(allowance.throttled_until(now, Nanos::MAX), None);
            allowance.record_read(50, 900, now);
            assert!(!allowance.is_backlogged(now));
        }
        // The network delays half a second of bytes.
        assert!(allowance.bytes(60 * SECOND) > 25_000);
        allowance.record_read(25_000, 25_000, 60 * SECOND);
        assert!(allowance.is_backlogged(60 * SECOND), "more may be there");
        allowance.record_read(10, 900, 60 * SECOND);
        assert_eq!(allowance.throttled_until(60 * SECOND, Nanos::MAX), None);
        assert!(!allowance.is_flooded(60 * SECOND) && !allowance.is_backlogged(60 * SECOND));
    }

    #[test]
    fn reader_is_backlogged_until_it_catches_up() {
        for (standstill, longest_ms) in [(1, 1), (5, 3_500), (20, 19_000)] {
            // The line sends without pauses.
            let arrived = |now: Nanos| (now / 20_000) as usize;
            let mut allowance = ReadBudget::new(BAUD, 0);
            let (mut now, mut read) = (standstill * SECOND, 0);
            let mut caught_up = None;
            while now < 60 * SECOND {
                if let Some(until) = allowance.throttled_until(now, Nanos::MAX) {
                    now = until;
                    continue;
                }
                let room = allowance.bytes(now).clamp(1, 900);
                let len = room.min(arrived(now) - read);
                allowance.record_read(len, room, now);
                // Age of the first byte that was read.
                let age = now - read as Nanos * 20_000;
                read += len;
                assert!(allowance.is_backlogged(now) || age <= 40 * MILLIS, "{age} ns old at {now}");
                match caught_up {
                    None if !allowance.is_backlogged(now) => caught_up = Some(now - standstill * SECOND),
                    None => {}
                    Some(_) => assert!(!allowance.is_backlogged(now), "once it has caught up"),
                }
                now += if len < room { MILLIS } else { 1 };
            }
            let took = caught_up.expect("it catches up");
            assert!(took <= longest_ms * MILLIS, "{standstill} s: {took}");
        }
    }

    #[test]
    fn throttled_read_waits_for_deadline_or_portion() {
        let mut allowance = ReadBudget::new(BAUD, SECOND);
        allowance.record_read(100_000, 100_000, SECOND);
        assert_eq!(allowance.bytes(SECOND), 0);
        let (byte, portion) = (SECOND + 10_000, SECOND + MIN_REFILL);
        assert_eq!(allowance.throttled_until(SECOND, SECOND + 1), Some(byte), "a byte has to be allowed");
        assert_eq!(allowance.throttled_until(SECOND, 0), Some(portion), "it is overdue");
        assert_eq!(allowance.throttled_until(SECOND, byte + 5), Some(byte + 5));
        assert_eq!(allowance.throttled_until(SECOND, Nanos::MAX), Some(portion));
        assert_eq!((allowance.bytes(byte), allowance.bytes(portion)), (1, 2_000));
        assert!(!allowance.is_flooded(portion), "it was short once");
    }
}
