//! Somebody who is connected: how far he came, from his request to the socket of a viewer. Refuses to know who else is there.

use std::io::{self, Read, Write};
use std::mem;
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use rustix::event::PollFlags;

use crate::server::board::Board;
use crate::server::listener::{Reply, Server};
use crate::server::playback::Playback;
use crate::server::request::{LONGEST, Request, upgrade};
use crate::server::viewer::{Gone, Viewer};

/// So long a request may take, and its answer, over a slow line.
const REQUEST_TIME: Duration = Duration::from_secs(10);
const ANSWER_TIME: Duration = Duration::from_secs(60);

/// What all guests are served from.
pub(crate) struct House<'a> {
    pub(crate) server: &'a Server,
    pub(crate) board: &'a Board,
    pub(crate) player: Option<&'a dyn Playback>,
    pub(crate) session: String,
}

/// Somebody who is connected.
pub(crate) struct Guest {
    pub(crate) address: SocketAddr,
    stage: Stage,
    pub(crate) is_gone: bool,
}

/// How far he came.
enum Stage {
    Request {
        stream: TcpStream,
        head: Vec<u8>,
        until: Instant,
    },
    Answer {
        stream: TcpStream,
        bytes: Vec<u8>,
        at: usize,
        until: Instant,
    },
    Viewer(Box<Viewer>),
    /// His connection was closed.
    Closed,
}

impl Guest {
    /// One who was let in just now.
    pub(crate) fn new(stream: TcpStream, address: SocketAddr, now: Instant) -> Guest {
        let stage = Stage::Request { stream, head: Vec::new(), until: now + REQUEST_TIME };
        Guest { address, stage, is_gone: false }
    }

    /// What is waited for at his connection, if he has one.
    pub(crate) fn waits_for(&self) -> Option<(&TcpStream, PollFlags)> {
        match &self.stage {
            Stage::Request { stream, .. } => Some((stream, PollFlags::IN)),
            Stage::Answer { stream, .. } => Some((stream, PollFlags::OUT)),
            Stage::Viewer(viewer) if viewer.is_pending() => {
                Some((viewer.stream(), PollFlags::IN | PollFlags::OUT))
            }
            Stage::Viewer(viewer) => Some((viewer.stream(), PollFlags::IN)),
            Stage::Closed => None,
        }
    }

    /// When something is to be done for him though nothing happens.
    pub(crate) fn wake_at(&self) -> Option<Instant> {
        match &self.stage {
            Stage::Request { until, .. } | Stage::Answer { until, .. } => Some(*until),
            Stage::Viewer(viewer) => viewer.wake_at(),
            Stage::Closed => None,
        }
    }

    /// He asked for nothing yet.
    pub(crate) fn is_silent(&self) -> bool {
        matches!(self.stage, Stage::Request { .. })
    }

    pub(crate) fn viewer(&mut self) -> Option<&mut Viewer> {
        match &mut self.stage {
            Stage::Viewer(viewer) => Some(viewer),
            _ => None,
        }
    }

    pub(crate) fn is_viewer(&self) -> bool {
        matches!(self.stage, Stage::Viewer(_))
    }

    /// Does what can be done for him; `viewers` are those that there are.
    pub(crate) fn serve(
        &mut self,
        house: &House<'_>,
        is_ready: bool,
        viewers: usize,
        now: Instant,
    ) -> Result<(), Gone> {
        match &mut self.stage {
            Stage::Request { until, .. } | Stage::Answer { until, .. } if now >= *until => Err(Gone),
            Stage::Request { stream, head, .. } if is_ready => {
                let Some((request, length)) = receive(stream, head)? else { return Ok(()) };
                self.reply(house, &request, length, viewers, now)?;
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
            Stage::Closed => Err(Gone),
        }
    }

    /// Goes on from a request whose head has `length` bytes; his connection is the same, so that no descriptor is needed.
    fn reply(
        &mut self,
        house: &House<'_>,
        request: &Request,
        length: usize,
        viewers: usize,
        now: Instant,
    ) -> Result<(), Gone> {
        let Stage::Request { mut stream, head, .. } = mem::replace(&mut self.stage, Stage::Closed) else {
            return Err(Gone);
        };
        self.stage = match house.server.reply(request, viewers) {
            Reply::Whole(bytes) => Stage::Answer { stream, bytes, at: 0, until: now + ANSWER_TIME },
            Reply::Socket { key, protocol } => {
                // It fits into the empty buffer of a new connection.
                stream.write_all(&upgrade(key, protocol)).map_err(|_| Gone)?;
                let early = head[length..].to_vec();
                Stage::Viewer(Box::new(Viewer::new(stream, early, &house.session, now)?))
            }
        };
        Ok(())
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
