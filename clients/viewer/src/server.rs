//! Web server with one page and one WebSocket. The page and other viewers use the WebSocket with the protocol
//! `foxglove.sdk.v1`. One thread serves all clients. A slow client gets only the newest messages, and does not delay
//! other clients.

mod channels;
mod connection;
mod foxglove;
mod http;
pub(crate) mod messages;
mod page;
pub mod player;
mod viewer;

use std::io;
use std::net::{SocketAddr, TcpListener};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::net::sockopt::set_socket_send_buffer_size;
use rustix::rand::{GetRandomFlags, getrandom};
use scanhub_schema::{Failure, Kind};

use connection::{Connection, ServerContext};
use page::Page;
use player::Playback;

pub use channels::{Channel, ChannelPublisher, ChannelStore};
pub use connection::MAX_VIEWERS;
pub use http::AccessPolicy;

/// Maximum number of connections, including those that only fetch the page.
const MAX_CONNECTIONS: usize = 64;
/// Number of further ports that are tried if the configured port is in use.
const PORT_ATTEMPTS: u16 = 20;
/// Size of the kernel's send buffer in bytes. The buffer is small, because data in it becomes old if the client is
/// slow.
const SEND_BUFFER_LEN: usize = 64 << 10;
/// Time for which no connections are accepted after descriptors ran out. Without this pause, the waiting connection
/// would keep the thread busy.
const ACCEPT_PAUSE: Duration = Duration::from_millis(200);
/// Minimum interval between two reports that no connection can be accepted.
const REPORT_INTERVAL: Duration = Duration::from_secs(10);
/// Maximum time for which the thread sleeps.
const MAX_SLEEP: Duration = Duration::from_secs(1);
/// Errors of a single connection. After such an error, the next connection can be accepted.
const CONNECTION_ERRORS: [io::ErrorKind; 3] =
    [io::ErrorKind::ConnectionAborted, io::ErrorKind::ConnectionReset, io::ErrorKind::Interrupted];

/// Event that the server reports.
#[derive(Debug)]
pub enum Event {
    /// A viewer connected or disconnected.
    Viewer(ViewerEvent),
    /// Connections cannot be accepted, because the system lacks a resource.
    ResourceExhausted(io::Error),
}

/// A viewer connected or disconnected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ViewerEvent {
    /// Address of the viewer.
    pub address: SocketAddr,
    /// Whether the viewer connected.
    pub connected: bool,
    /// Number of messages that newer messages replaced before they could be sent.
    pub replaced: u64,
    /// Number of viewers that are connected now.
    pub viewers: usize,
}

/// Server that listens on an address.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    policy: AccessPolicy,
    page: Page,
}

impl Server {
    /// Listens on `address`, or on one of the next ports if that port is in use.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`] if no port is free, or if the address does not belong to this machine.
    pub fn bind(address: SocketAddr, policy: AccessPolicy) -> Result<Server, Failure> {
        let last = if address.port() == 0 { 0 } else { address.port().saturating_add(PORT_ATTEMPTS) };
        let mut in_use = None;
        for port in address.port()..=last {
            match TcpListener::bind(SocketAddr::new(address.ip(), port)) {
                Ok(listener) => {
                    let bound = listener.set_nonblocking(true).and_then(|()| listener.local_addr());
                    let address = bound.map_err(|error| cannot_listen(address, &error))?;
                    return Ok(Server { listener, address, policy, page: Page::new() });
                }
                Err(error) if error.kind() == io::ErrorKind::AddrInUse => in_use = Some(error),
                Err(error) => return Err(cannot_listen(address, &error)),
            }
        }
        let error = in_use.unwrap_or_else(|| io::ErrorKind::AddrInUse.into());
        Err(cannot_listen(address, &error))
    }

    /// Returns the address on which the server listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Serves `channels`, and passes commands of viewers to the `player`, until `stop` is set and
    /// [`ChannelStore::wake`] is called. Sends reports to `events`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`] if the system does not provide random numbers, or if waiting for sockets fails.
    pub fn run(
        &self,
        channels: &ChannelStore,
        player: Option<&dyn Playback>,
        events: &Sender<Event>,
        stop: &AtomicBool,
    ) -> Result<(), Failure> {
        let mut connections: Vec<Connection> = Vec::new();
        let context =
            ServerContext { policy: &self.policy, page: &self.page, channels, player, session: session()? };
        let (mut paused_until, mut report_at): (Option<Instant>, Option<Instant>) = (None, None);
        while !stop.load(Ordering::Relaxed) {
            let (is_new, ready) = self.wait(channels, &connections, paused_until)?;
            channels.clear_wake();
            let now = Instant::now();
            paused_until = paused_until.filter(|until| now < *until);
            let mut viewers = connections.iter().filter(|connection| connection.is_viewer()).count();
            for (connection, is_ready) in connections.iter_mut().zip(ready) {
                let was_viewer = connection.is_viewer();
                connection.is_closed = connection.serve(&context, is_ready, viewers, now).is_err();
                let (address, is_closed) = (connection.address, connection.is_closed);
                let Some(viewer) = connection.viewer() else { continue };
                if is_closed {
                    viewer.unsubscribe_all(channels);
                }
                // Report a viewer that disconnected, and a client that became a viewer.
                if was_viewer == is_closed {
                    viewers = if is_closed { viewers - 1 } else { viewers + 1 };
                    let replaced = viewer.replaced_count();
                    let event = ViewerEvent { address, connected: !is_closed, replaced, viewers };
                    let _ = events.send(Event::Viewer(event));
                }
            }
            connections.retain(|connection| !connection.is_closed);
            if let Some(Err(error)) = is_new.then(|| self.accept(&mut connections, now)) {
                paused_until = Some(now + ACCEPT_PAUSE);
                if report_at.is_none_or(|at| now >= at) {
                    report_at = Some(now + REPORT_INTERVAL);
                    let _ = events.send(Event::ResourceExhausted(error));
                }
            }
        }
        Ok(())
    }

    /// Sleeps until a socket is ready, the server is woken, or a timeout expires. Returns whether a connection can be
    /// accepted, and which connections can be read or written.
    fn wait(
        &self,
        channels: &ChannelStore,
        connections: &[Connection],
        paused_until: Option<Instant>,
    ) -> Result<(bool, Vec<bool>), Failure> {
        let wake = channels.wake_fd();
        let accepts = if paused_until.is_none() { PollFlags::IN } else { PollFlags::empty() };
        let mut fds = vec![PollFd::new(&self.listener, accepts), PollFd::new(&wake, PollFlags::IN)];
        let sockets = connections.iter().filter_map(Connection::waits_for);
        fds.extend(sockets.map(|(stream, flags)| PollFd::new(stream, flags)));
        let wake_at = connections.iter().filter_map(Connection::wake_at).chain(paused_until).min();
        let left =
            wake_at.map_or(MAX_SLEEP, |at| at.saturating_duration_since(Instant::now()).min(MAX_SLEEP));
        let left = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: i64::from(left.subsec_nanos()) };
        match poll(&mut fds, Some(&left)) {
            Ok(_) | Err(Errno::INTR | Errno::AGAIN) => {}
            Err(error) => {
                let hint = "start it again; if that lasts, raise the limits: ulimit -n, memory";
                return Err(Failure::new(Kind::Failed, format!("cannot wait for viewers: {error}"), hint));
            }
        }
        let mut ready = fds.iter().map(|fd| !fd.revents().is_empty());
        let is_new = ready.next() == Some(true);
        let mut ready = ready.skip(1);
        let is_ready =
            |connection: &Connection| connection.waits_for().is_some() && ready.next() == Some(true);
        Ok((is_new, connections.iter().map(is_ready).collect()))
    }

    /// Accepts all waiting connections. An error means that the system lacks a resource.
    fn accept(&self, connections: &mut Vec<Connection>, now: Instant) -> io::Result<()> {
        loop {
            let (stream, address) = match self.listener.accept() {
                Ok(accepted) => accepted,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(()),
                Err(error) if CONNECTION_ERRORS.contains(&error.kind()) => continue,
                Err(error) => return Err(error),
            };
            if stream.set_nonblocking(true).is_err() {
                continue;
            }
            // At the limit, disconnect a client that has sent no request, so that idle clients cannot block others.
            if connections.len() >= MAX_CONNECTIONS {
                let Some(silent) = connections.iter().position(Connection::is_silent) else { continue };
                connections.remove(silent);
            }
            let _ = stream.set_nodelay(true);
            let _ = set_socket_send_buffer_size(&stream, SEND_BUFFER_LEN);
            connections.push(Connection::new(stream, address, now));
        }
    }
}

fn cannot_listen(address: SocketAddr, error: &io::Error) -> Failure {
    let hint = "name an address of this machine, or a free port: --listen 8090";
    Failure::new(Kind::Failed, format!("cannot listen on {address}: {error}"), hint)
}

/// Returns a random ID for this run of the server. Time and process ID are not used, because they can repeat, above all
/// in containers.
fn session() -> Result<String, Failure> {
    let no_random =
        |why: &str| Failure::new(Kind::Failed, format!("no random numbers: {why}"), "start it again");
    let mut bytes = [0; 16];
    match getrandom(&mut bytes, GetRandomFlags::empty()) {
        Ok(count) if count == bytes.len() => Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect()),
        Ok(_) => Err(no_random("too few bytes")),
        Err(error) => Err(no_random(&error.to_string())),
    }
}
