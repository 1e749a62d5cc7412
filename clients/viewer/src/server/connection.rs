//! One connection, from the HTTP request to the WebSocket of a viewer.

use std::io::{self, Read, Write};
use std::mem;
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use rustix::event::PollFlags;

use super::channels::ChannelStore;
use super::foxglove::PROTOCOLS;
use super::http::{AccessPolicy, MAX_HEAD_LEN, Request, response, text_response, upgrade_response};
use super::page::Page;
use super::player::Playback;
use super::viewer::{Disconnected, Viewer};

/// Maximum number of viewers.
pub const MAX_VIEWERS: usize = 32;

/// Timeout for the request of a client.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(10);
/// Timeout for sending the response. This time allows for a slow network.
const RESPONSE_TIMEOUT: Duration = Duration::from_secs(60);

/// State that all connections share.
pub(crate) struct ServerContext<'a> {
    pub(crate) policy: &'a AccessPolicy,
    pub(crate) page: &'a Page,
    pub(crate) channels: &'a ChannelStore,
    pub(crate) player: Option<&'a dyn Playback>,
    /// ID of this run of the server.
    pub(crate) session: String,
}

/// A connection of a client.
pub(crate) struct Connection {
    pub(crate) address: SocketAddr,
    state: ConnectionState,
    /// Whether the connection has ended.
    pub(crate) is_closed: bool,
}

enum ConnectionState {
    Request {
        stream: TcpStream,
        head: Vec<u8>,
        until: Instant,
    },
    Response {
        stream: TcpStream,
        bytes: Vec<u8>,
        /// Number of bytes that were sent.
        sent: usize,
        until: Instant,
    },
    Viewer(Box<Viewer>),
    Closed,
}

impl Connection {
    /// Creates a connection that was just accepted.
    pub(crate) fn new(stream: TcpStream, address: SocketAddr, now: Instant) -> Connection {
        let state = ConnectionState::Request { stream, head: Vec::new(), until: now + REQUEST_TIMEOUT };
        Connection { address, state, is_closed: false }
    }

    /// Returns the socket, and the events on it for which the connection waits.
    pub(crate) fn waits_for(&self) -> Option<(&TcpStream, PollFlags)> {
        match &self.state {
            ConnectionState::Request { stream, .. } => Some((stream, PollFlags::IN)),
            ConnectionState::Response { stream, .. } => Some((stream, PollFlags::OUT)),
            ConnectionState::Viewer(viewer) if viewer.is_pending() => {
                Some((viewer.stream(), PollFlags::IN | PollFlags::OUT))
            }
            ConnectionState::Viewer(viewer) => Some((viewer.stream(), PollFlags::IN)),
            ConnectionState::Closed => None,
        }
    }

    /// Returns the time at which the connection must be served even if no input arrives, for example for a timeout.
    pub(crate) fn wake_at(&self) -> Option<Instant> {
        match &self.state {
            ConnectionState::Request { until, .. } | ConnectionState::Response { until, .. } => Some(*until),
            ConnectionState::Viewer(viewer) => viewer.wake_at(),
            ConnectionState::Closed => None,
        }
    }

    /// Returns whether no complete request has arrived yet.
    pub(crate) fn is_silent(&self) -> bool {
        matches!(self.state, ConnectionState::Request { .. })
    }

    pub(crate) fn viewer(&mut self) -> Option<&mut Viewer> {
        match &mut self.state {
            ConnectionState::Viewer(viewer) => Some(viewer),
            _ => None,
        }
    }

    pub(crate) fn is_viewer(&self) -> bool {
        matches!(self.state, ConnectionState::Viewer(_))
    }

    /// Reads and writes as far as the socket allows. `viewers` is the number of viewers that are connected.
    pub(crate) fn serve(
        &mut self,
        context: &ServerContext<'_>,
        is_ready: bool,
        viewers: usize,
        now: Instant,
    ) -> Result<(), Disconnected> {
        match &mut self.state {
            ConnectionState::Request { until, .. } | ConnectionState::Response { until, .. }
                if now >= *until =>
            {
                Err(Disconnected)
            }
            ConnectionState::Request { stream, head, .. } if is_ready => {
                let Some((request, length)) = receive(stream, head)? else { return Ok(()) };
                self.reply(context, &request, length, viewers, now)?;
                self.serve(context, true, viewers, now)
            }
            ConnectionState::Request { .. } => Ok(()),
            ConnectionState::Response { stream, bytes, sent: at, .. } => match stream.write(&bytes[*at..]) {
                Ok(0) => Err(Disconnected),
                Ok(written) => {
                    *at += written;
                    if *at == bytes.len() { Err(Disconnected) } else { Ok(()) }
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => Ok(()),
                Err(_) => Err(Disconnected),
            },
            ConnectionState::Viewer(viewer) => {
                if is_ready || viewer.has_unread_messages() {
                    viewer.receive(context.channels, context.player)?;
                }
                viewer.serve(context.channels, now)
            }
            ConnectionState::Closed => Err(Disconnected),
        }
    }

    /// Replies to a request whose head has `length` bytes. A WebSocket uses the socket of the request, so it needs no
    /// further descriptor.
    fn reply(
        &mut self,
        context: &ServerContext<'_>,
        request: &Request,
        length: usize,
        viewers: usize,
        now: Instant,
    ) -> Result<(), Disconnected> {
        let state = mem::replace(&mut self.state, ConnectionState::Closed);
        let ConnectionState::Request { mut stream, head, .. } = state else { return Err(Disconnected) };
        self.state = match context.reply(request, viewers) {
            Reply::Response(bytes) => {
                ConnectionState::Response { stream, bytes, sent: 0, until: now + RESPONSE_TIMEOUT }
            }
            Reply::WebSocket { key, protocol } => {
                // The response fits into the empty buffer of a new connection.
                stream.write_all(&upgrade_response(key, protocol)).map_err(|_| Disconnected)?;
                let early = head[length..].to_vec();
                let viewer = Viewer::new(stream, early, &context.session, now)?;
                ConnectionState::Viewer(Box::new(viewer))
            }
        };
        Ok(())
    }
}

/// Reads the next bytes of a head. Returns the request and the length of its head once the head is complete.
fn receive(stream: &mut TcpStream, head: &mut Vec<u8>) -> Result<Option<(Request, usize)>, Disconnected> {
    let mut buffer = [0; MAX_HEAD_LEN];
    loop {
        match stream.read(&mut buffer[..MAX_HEAD_LEN - head.len().min(MAX_HEAD_LEN)]) {
            Ok(0) => return Err(Disconnected),
            Ok(length) => head.extend(&buffer[..length]),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(None),
            Err(_) => return Err(Disconnected),
        }
        if let Some(request) = Request::parse(head).map_err(|_| Disconnected)? {
            return Ok(Some(request));
        }
    }
}

/// Result of a request.
enum Reply<'a> {
    /// Response with these bytes, after which the connection is closed.
    Response(Vec<u8>),
    /// WebSocket with this subprotocol, for the key of the handshake.
    WebSocket { key: &'a str, protocol: &'static str },
}

impl ServerContext<'_> {
    /// Returns the result of a request. `viewers` is the number of connected viewers.
    fn reply<'a>(&self, request: &'a Request, viewers: usize) -> Reply<'a> {
        let text = |status, text| Reply::Response(text_response(status, text));
        if let Err(refusal) = self.policy.check(request) {
            return Reply::Response(refusal.response());
        }
        if request.method != "GET" {
            return text("405 Method Not Allowed", "nothing here can be changed: GET alone");
        }
        if request.path != "/" {
            return text("404 Not Found", "there is one page: /");
        }
        let Some(key) = &request.key else {
            let policy = self.page.policy(request.host.as_deref().unwrap_or_default());
            return Reply::Response(response("200 OK", "text/html", &policy, self.page.body.as_bytes()));
        };
        let Some(protocol) = PROTOCOLS.into_iter().find(|protocol| request.offers(protocol)) else {
            return text("400 Bad Request", "the socket speaks foxglove.sdk.v1");
        };
        if viewers >= MAX_VIEWERS {
            return text("503 Service Unavailable", "as many viewers as there may be: close one");
        }
        Reply::WebSocket { key, protocol }
    }
}
