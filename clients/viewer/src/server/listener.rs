//! The one thread that serves all viewers: it takes connections, answers their requests, and sends what is new. It sleeps
//! until something happens. Refuses to know what is sent.

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

use crate::server::board::Board;
use crate::server::door::{Door, Refusal};
use crate::server::foxglove::PROTOCOLS;
use crate::server::guest::{Guest, House};
use crate::server::page::Page;
use crate::server::playback::Playback;
use crate::server::request::{Request, answer, words};

/// The most viewers at a time.
pub const VIEWERS: usize = 32;
/// The most connections, with those that only fetch the page.
const CONNECTIONS: usize = 64;
/// Where a port is taken, so many after it are tried.
const PORTS: u16 = 20;
/// What the kernel keeps for a viewer who is slow grows old there.
const SEND_BUFFER: usize = 64 << 10;

/// What happened at the door.
#[derive(Debug)]
pub enum Event {
    /// A viewer came or went.
    Viewer(Visit),
    /// Nobody can be let in, because the system is short of something; told every ten seconds while that lasts.
    Short(io::Error),
}

/// A viewer came or went.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Visit {
    /// Where he is.
    pub address: SocketAddr,
    /// He came; else he went.
    pub came: bool,
    /// Messages that he was too slow for.
    pub skipped: u64,
    /// How many there are now.
    pub viewers: usize,
}

/// What is listened on.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    door: Door,
    page: Page,
}

impl Server {
    /// Listens on `address`, or if its port is taken, on one of the next.
    ///
    /// # Errors
    ///
    /// [`Kind::Failed`] if none is free, or the address is not this machine's.
    pub fn bind(address: SocketAddr, door: Door) -> Result<Server, Failure> {
        let last = if address.port() == 0 { 0 } else { address.port().saturating_add(PORTS) };
        let mut refused = None;
        for port in address.port()..=last {
            match TcpListener::bind(SocketAddr::new(address.ip(), port)) {
                Ok(listener) => {
                    let bound = listener.set_nonblocking(true).and_then(|()| listener.local_addr());
                    let address = bound.map_err(|error| cannot(address, &error))?;
                    return Ok(Server { listener, address, door, page: Page::new() });
                }
                Err(error) if error.kind() == io::ErrorKind::AddrInUse => refused = Some(error),
                Err(error) => return Err(cannot(address, &error)),
            }
        }
        let error = refused.unwrap_or_else(|| io::ErrorKind::AddrInUse.into());
        Err(cannot(address, &error))
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Serves what is on `board`, and hands orders to the `player`, until `stop`, which [`Board::ring`] makes it see; tells `events` who comes and goes.
    ///
    /// # Errors
    ///
    /// [`Kind::Failed`] if the system does not say any more who can be served.
    pub fn run(
        &self,
        board: &Board,
        player: Option<&dyn Playback>,
        events: &Sender<Event>,
        stop: &AtomicBool,
    ) -> Result<(), Failure> {
        let mut guests: Vec<Guest> = Vec::new();
        let house = House { server: self, board, player, session: session()? };
        let mut shortage = Shortage::default();
        while !stop.load(Ordering::Relaxed) {
            let (is_new, ready) = self.wait(board, &guests, shortage.until)?;
            board.rang();
            let now = Instant::now();
            shortage.until = shortage.until.filter(|until| now < *until);
            let mut viewers = guests.iter().filter(|guest| guest.is_viewer()).count();
            for (guest, is_ready) in guests.iter_mut().zip(ready) {
                let was_viewer = guest.is_viewer();
                guest.is_gone = guest.serve(&house, is_ready, viewers, now).is_err();
                let (address, is_gone) = (guest.address, guest.is_gone);
                let Some(viewer) = guest.viewer() else { continue };
                if is_gone {
                    viewer.leave(board);
                }
                if was_viewer != is_gone {
                    continue;
                }
                // A viewer who went, or somebody who became one.
                viewers = if is_gone { viewers - 1 } else { viewers + 1 };
                let visit = Visit { address, came: !is_gone, skipped: viewer.skipped(), viewers };
                let _ = events.send(Event::Viewer(visit));
            }
            guests.retain(|guest| !guest.is_gone);
            if let Some(Err(error)) = is_new.then(|| self.take(&mut guests, now)) {
                shortage.until = Some(now + SHORTAGE);
                if shortage.tell_at.is_none_or(|at| now >= at) {
                    shortage.tell_at = Some(now + TELL_EVERY);
                    let _ = events.send(Event::Short(error));
                }
            }
        }
        Ok(())
    }

    /// Sleeps until something happens: whether somebody is at the door, and which guests can be read or written.
    fn wait(
        &self,
        board: &Board,
        guests: &[Guest],
        closed_until: Option<Instant>,
    ) -> Result<(bool, Vec<bool>), Failure> {
        let bell = board.bell();
        let door = if closed_until.is_none() { PollFlags::IN } else { PollFlags::empty() };
        let mut ends = vec![PollFd::new(&self.listener, door), PollFd::new(&bell, PollFlags::IN)];
        ends.extend(
            guests.iter().filter_map(Guest::waits_for).map(|(stream, flags)| PollFd::new(stream, flags)),
        );
        let wake_at = guests.iter().filter_map(Guest::wake_at).chain(closed_until).min();
        let left = wake_at.map_or(IDLE, |at| at.saturating_duration_since(Instant::now()).min(IDLE));
        let left = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: i64::from(left.subsec_nanos()) };
        match poll(&mut ends, Some(&left)) {
            Ok(_) | Err(Errno::INTR | Errno::AGAIN) => {}
            Err(error) => {
                let hint = "start it again; if that lasts, raise the limits: ulimit -n, memory";
                return Err(Failure::new(Kind::Failed, format!("cannot wait for viewers: {error}"), hint));
            }
        }
        let is_ready = |end: &PollFd<'_>| !end.revents().is_empty();
        let mut told = ends[2..].iter().map(is_ready);
        let of_guest = |guest: &Guest| guest.waits_for().is_some() && told.next() == Some(true);
        let ready = guests.iter().map(of_guest).collect();
        Ok((is_ready(&ends[0]), ready))
    }

    /// Lets in who is at the door; an error if the system is short of something.
    fn take(&self, guests: &mut Vec<Guest>, now: Instant) -> io::Result<()> {
        loop {
            let (stream, address) = match self.listener.accept() {
                Ok(guest) => guest,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(()),
                // He went before he was let in.
                Err(error) if PASSING.contains(&error.kind()) => continue,
                Err(error) => return Err(error),
            };
            if stream.set_nonblocking(true).is_err() {
                continue;
            }
            // Whoever is too many is shut out before he costs anything; but whoever says nothing keeps nobody out.
            if guests.len() >= CONNECTIONS {
                let Some(silent) = guests.iter().position(Guest::is_silent) else { continue };
                guests.remove(silent);
            }
            let _ = stream.set_nodelay(true);
            let _ = set_socket_send_buffer_size(&stream, SEND_BUFFER);
            guests.push(Guest::new(stream, address, now));
        }
    }

    /// What a whole request gets, where there are so many viewers.
    pub(crate) fn reply<'a>(&self, request: &'a Request, viewers: usize) -> Reply<'a> {
        if let Err(refusal) = self.door.check(&request.caller()) {
            let status = match refusal {
                Refusal::Token => "401 Unauthorized",
                Refusal::Host | Refusal::Origin => "403 Forbidden",
            };
            return Reply::Whole(words(status, refusal.words()));
        }
        if request.method != "GET" {
            return Reply::Whole(words("405 Method Not Allowed", "nothing here can be changed: GET alone"));
        }
        if request.path != "/" {
            return Reply::Whole(words("404 Not Found", "there is one page: /"));
        }
        let Some(key) = &request.key else {
            let policy = self.page.policy(request.caller().host.unwrap_or_default());
            return Reply::Whole(answer("200 OK", "text/html", &policy, self.page.body.as_bytes()));
        };
        let Some(protocol) = PROTOCOLS.into_iter().find(|protocol| request.offers(protocol)) else {
            return Reply::Whole(words("400 Bad Request", "the socket speaks foxglove.sdk.v1"));
        };
        if viewers >= VIEWERS {
            let full = "as many viewers as there may be: close one";
            return Reply::Whole(words("503 Service Unavailable", full));
        }
        Reply::Socket { key, protocol }
    }
}

/// What a request gets.
pub(crate) enum Reply<'a> {
    /// These bytes, and the connection is closed.
    Whole(Vec<u8>),
    /// A WebSocket of this protocol, for the key of the handshake.
    Socket { key: &'a str, protocol: &'static str },
}

/// Where no descriptor is left, whoever is at the door waits for a while: he would not let this thread sleep.
#[derive(Default)]
struct Shortage {
    /// Until when the door is not looked at.
    until: Option<Instant>,
    /// Before that it is not told again.
    tell_at: Option<Instant>,
}

fn cannot(address: SocketAddr, error: &io::Error) -> Failure {
    let hint = "name an address of this machine, or a free port: --listen 8090";
    Failure::new(Kind::Failed, format!("cannot listen on {address}: {error}"), hint)
}

/// Of one server, and of no other one: time and process id repeat, in containers above all.
fn session() -> Result<String, Failure> {
    let mut bytes = [0; 16];
    match getrandom(&mut bytes, GetRandomFlags::empty()) {
        Ok(count) if count == bytes.len() => Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect()),
        Ok(_) => Err(no_random("too few bytes")),
        Err(error) => Err(no_random(error)),
    }
}

fn no_random(why: impl std::fmt::Display) -> Failure {
    Failure::new(Kind::Failed, format!("no random numbers: {why}"), "start it again")
}

/// Errors of a connection, not of the door.
const PASSING: [io::ErrorKind; 3] =
    [io::ErrorKind::ConnectionAborted, io::ErrorKind::ConnectionReset, io::ErrorKind::Interrupted];
/// So long nobody is let in where descriptors are short.
const SHORTAGE: Duration = Duration::from_millis(200);
/// Between two words about that.
const TELL_EVERY: Duration = Duration::from_secs(10);
/// Where nothing happens.
const IDLE: Duration = Duration::from_secs(1);
