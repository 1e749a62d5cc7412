//! The one thread that serves all viewers: it takes connections, answers their requests, and sends what is new. It sleeps
//! until something happens. Refuses to know what is sent.

use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::net::sockopt::set_socket_send_buffer_size;
use schema::{Failure, Kind};

use crate::board::Board;
use crate::door::{Door, Refusal};
use crate::foxglove::PROTOCOL;
use crate::page::Page;
use crate::playback::Playback;
use crate::request::{LONGEST, Request, answer, upgrade, words};
use crate::viewer::{Gone, Viewer};

/// The most viewers at a time.
pub const VIEWERS: usize = 32;
/// The most connections, with those that only fetch the page.
const CONNECTIONS: usize = 64;
/// So long a request may take, and its answer, over a slow line.
const REQUEST_TIME: Duration = Duration::from_secs(10);
const ANSWER_TIME: Duration = Duration::from_secs(60);
/// Where a port is taken, so many after it are tried.
const PORTS: u16 = 20;
/// What the kernel keeps for a viewer who is slow grows old there.
const SEND_BUFFER: usize = 64 << 10;

/// A viewer came or went.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Event {
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
        let house = House { server: self, board, player, session: session() };
        // Where no descriptor is left, whoever is at the door waits for a while: he would not let this thread sleep.
        let mut closed_until = None;
        while !stop.load(Ordering::Relaxed) {
            let (is_new, ready) = self.wait(board, &guests, closed_until)?;
            board.rang();
            let now = Instant::now();
            closed_until = closed_until.filter(|until| now < *until);
            let mut viewers = guests.iter().filter(|guest| matches!(guest.stage, Stage::Viewer(_))).count();
            for (guest, is_ready) in guests.iter_mut().zip(ready) {
                let was_viewer = matches!(guest.stage, Stage::Viewer(_));
                let served = guest.serve(&house, is_ready, viewers, now);
                guest.is_gone = served.is_err();
                let skipped = match &mut guest.stage {
                    Stage::Viewer(viewer) => {
                        if guest.is_gone {
                            viewer.leave(board);
                        }
                        viewer.skipped()
                    }
                    _ => continue,
                };
                if was_viewer != guest.is_gone {
                    continue;
                }
                // A viewer who went, or somebody who became one.
                viewers = if guest.is_gone { viewers - 1 } else { viewers + 1 };
                let _ = events.send(Event { address: guest.address, came: !guest.is_gone, skipped, viewers });
            }
            guests.retain(|guest| !guest.is_gone);
            if is_new && self.take(&mut guests, now).is_err() {
                closed_until = Some(now + SHORTAGE);
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
        for guest in guests {
            ends.push(PollFd::new(guest.stream(), guest.waits_for()));
        }
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
        Ok((is_ready(&ends[0]), ends[2..].iter().map(is_ready).collect()))
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
                let silent = guests.iter().position(|guest| matches!(guest.stage, Stage::Request { .. }));
                let Some(silent) = silent else { continue };
                guests.remove(silent);
            }
            let _ = stream.set_nodelay(true);
            let _ = set_socket_send_buffer_size(&stream, SEND_BUFFER);
            let stage = Stage::Request { stream, head: Vec::new(), until: now + REQUEST_TIME };
            guests.push(Guest { address, stage, is_gone: false });
        }
    }

    /// What a whole request gets; nothing if it becomes a viewer's socket.
    fn answer(&self, request: &Request, viewers: usize) -> Option<Vec<u8>> {
        if let Err(refusal) = self.door.check(&request.caller()) {
            let status = match refusal {
                Refusal::Token => "401 Unauthorized",
                Refusal::Host | Refusal::Origin => "403 Forbidden",
            };
            return Some(words(status, refusal.words()));
        }
        if request.method != "GET" {
            return Some(words("405 Method Not Allowed", "nothing here can be changed: GET alone"));
        }
        if request.path != "/" {
            return Some(words("404 Not Found", "there is one page: /"));
        }
        if request.key.is_none() {
            let policy = self.page.policy(request.caller().host.unwrap_or_default());
            return Some(answer("200 OK", "text/html", &policy, self.page.body.as_bytes()));
        }
        if !request.offers(PROTOCOL) {
            return Some(words("400 Bad Request", "the socket speaks foxglove.sdk.v1"));
        }
        if viewers >= VIEWERS {
            return Some(words("503 Service Unavailable", "as many viewers as there may be: close one"));
        }
        None
    }
}

/// What all guests are served from.
struct House<'a> {
    server: &'a Server,
    board: &'a Board,
    player: Option<&'a dyn Playback>,
    session: String,
}

/// Somebody who is connected.
struct Guest {
    address: SocketAddr,
    stage: Stage,
    is_gone: bool,
}

/// How far he came.
enum Stage {
    Request { stream: TcpStream, head: Vec<u8>, until: Instant },
    Answer { stream: TcpStream, bytes: Vec<u8>, at: usize, until: Instant },
    Viewer(Box<Viewer>),
}

impl Guest {
    fn stream(&self) -> &TcpStream {
        match &self.stage {
            Stage::Request { stream, .. } | Stage::Answer { stream, .. } => stream,
            Stage::Viewer(viewer) => viewer.stream(),
        }
    }

    fn waits_for(&self) -> PollFlags {
        match &self.stage {
            Stage::Request { .. } => PollFlags::IN,
            Stage::Answer { .. } => PollFlags::OUT,
            Stage::Viewer(viewer) if viewer.is_pending() => PollFlags::IN | PollFlags::OUT,
            Stage::Viewer(_) => PollFlags::IN,
        }
    }

    fn wake_at(&self) -> Option<Instant> {
        match &self.stage {
            Stage::Request { until, .. } | Stage::Answer { until, .. } => Some(*until),
            Stage::Viewer(viewer) => viewer.wake_at(),
        }
    }

    fn serve(&mut self, house: &House<'_>, is_ready: bool, viewers: usize, now: Instant) -> Result<(), Gone> {
        match &mut self.stage {
            Stage::Request { until, .. } | Stage::Answer { until, .. } if now >= *until => Err(Gone),
            Stage::Request { stream, head, .. } if is_ready => {
                let Some((request, length)) = receive(stream, head)? else { return Ok(()) };
                let stream = stream.try_clone().map_err(|_| Gone)?;
                self.stage = match house.server.answer(&request, viewers) {
                    Some(bytes) => Stage::Answer { stream, bytes, at: 0, until: now + ANSWER_TIME },
                    None => {
                        // It fits into the empty buffer of a new connection.
                        let key = request.key.unwrap_or_default();
                        (&stream).write_all(&upgrade(&key, PROTOCOL)).map_err(|_| Gone)?;
                        Stage::Viewer(Box::new(Viewer::new(
                            stream,
                            head[length..].to_vec(),
                            &house.session,
                            now,
                        )?))
                    }
                };
                self.serve(house, true, viewers, now)
            }
            Stage::Request { .. } => Ok(()),
            Stage::Answer { stream, bytes, at, .. } => match stream.write(&bytes[*at..]) {
                Ok(0) => Err(Gone),
                Ok(written) => {
                    *at += written;
                    if *at == bytes.len() { Err(Gone) } else { Ok(()) }
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => Ok(()),
                Err(_) => Err(Gone),
            },
            Stage::Viewer(viewer) => {
                if is_ready || viewer.hears_more() {
                    viewer.hear(house.board, house.player)?;
                }
                viewer.serve(house.board, now)
            }
        }
    }
}

/// Reads on at a head; the request when it is whole.
fn receive(stream: &mut TcpStream, head: &mut Vec<u8>) -> Result<Option<(Request, usize)>, Gone> {
    let mut room = [0; LONGEST];
    loop {
        match stream.read(&mut room[..LONGEST - head.len().min(LONGEST)]) {
            Ok(0) => return Err(Gone),
            Ok(length) => head.extend(&room[..length]),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(None),
            Err(_) => return Err(Gone),
        }
        if let Some(request) = Request::parse(head).map_err(|_| Gone)? {
            return Ok(Some(request));
        }
    }
}

fn cannot(address: SocketAddr, error: &io::Error) -> Failure {
    let hint = "name an address of this machine and a free port: --listen 127.0.0.1:8080";
    Failure::new(Kind::Failed, format!("cannot listen on {address}: {error}"), hint)
}

/// Of one server: two of them are two, and so are two in one process.
fn session() -> String {
    static SERVERS: AtomicU32 = AtomicU32::new(0);
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos();
    format!("{since:x}-{:x}-{:x}", std::process::id(), SERVERS.fetch_add(1, Ordering::Relaxed))
}

/// Errors of a connection, not of the door.
const PASSING: [io::ErrorKind; 3] =
    [io::ErrorKind::ConnectionAborted, io::ErrorKind::ConnectionReset, io::ErrorKind::Interrupted];
/// So long nobody is let in where descriptors are short.
const SHORTAGE: Duration = Duration::from_millis(200);
/// Where nothing happens.
const IDLE: Duration = Duration::from_secs(1);
