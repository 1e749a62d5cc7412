//! One viewer at his WebSocket: what he subscribed to, and what he gets next. Few messages of his are on their way, so that
//! his memory is bounded and he gets the newest when he is ready. Refuses to know where messages come from.

use std::io;
use std::net::TcpStream;
use std::time::{Duration, Instant};

use tungstenite::protocol::{Role, WebSocketConfig};
use tungstenite::{Bytes, Error, Message, WebSocket};

use crate::board::{Board, Newest};
use crate::foxglove::{self, Wish};
use crate::playback::Playback;

/// The most subscriptions of one viewer.
const SUBSCRIPTIONS: usize = 256;
/// The longest message of a viewer: room for subscribing to everything.
const LONGEST: usize = 64 << 10;
/// What one viewer says at a time, in messages: the others' turn comes, too.
const HEARD: usize = 32;
/// What is sent at a time, in bytes: few system calls for many small messages, and little that grows old on its way.
const PIECE: usize = 16 << 10;
/// So long a message may be on its way before the viewer is given up.
const PATIENCE: Duration = Duration::from_secs(30);
/// Between two words about what was skipped.
const TELL_EVERY: Duration = Duration::from_secs(1);

pub(crate) struct Viewer {
    socket: WebSocket<TcpStream>,
    subscriptions: Vec<Subscription>,
    /// Channels that he was told of.
    told: usize,
    /// Whose turn it is.
    next: usize,
    /// Since when a message is on its way.
    pending: Option<Instant>,
    skipped: u64,
    told_skipped: u64,
    tell_at: Instant,
    /// The last channel that he asked for in vain.
    unknown: Option<usize>,
    /// He may have said more than was heard, though nothing new comes.
    hears_more: bool,
}

struct Subscription {
    id: u32,
    channel: usize,
    /// The last message that he got, or that was there before him.
    number: u64,
}

/// The viewer is gone, or is to go.
#[derive(Debug)]
pub(crate) struct Gone;

impl Viewer {
    /// A viewer whose handshake was answered; `early` is what he said behind it.
    pub(crate) fn new(
        stream: TcpStream,
        early: Vec<u8>,
        session: &str,
        now: Instant,
    ) -> Result<Viewer, Gone> {
        let config = WebSocketConfig::default()
            .read_buffer_size(4096)
            .write_buffer_size(2 * PIECE)
            .max_message_size(Some(LONGEST))
            .max_frame_size(Some(LONGEST));
        let mut viewer = Viewer {
            socket: WebSocket::from_partially_read(stream, early, Role::Server, Some(config)),
            subscriptions: Vec::new(),
            told: 0,
            next: 0,
            pending: None,
            skipped: 0,
            told_skipped: 0,
            tell_at: now,
            unknown: None,
            hears_more: true,
        };
        viewer.send(Message::text(foxglove::server_info(session)), now)?;
        viewer.flush(now)?;
        Ok(viewer)
    }

    pub(crate) fn stream(&self) -> &TcpStream {
        self.socket.get_ref()
    }

    /// A message is on its way: what can be written next is waited for.
    pub(crate) fn is_pending(&self) -> bool {
        self.pending.is_some()
    }

    /// Messages that were replaced by newer ones before he was ready; how things are is told as often as he can hear it.
    pub(crate) fn skipped(&self) -> u64 {
        self.skipped
    }

    /// He may have said more than [`hear`](Self::hear) took.
    pub(crate) fn hears_more(&self) -> bool {
        self.hears_more
    }

    /// When something is to be done though nothing happens.
    pub(crate) fn wake_at(&self) -> Option<Instant> {
        let gives_up = self.pending.map(|since| since + PATIENCE);
        let tells = (self.skipped > self.told_skipped).then_some(self.tell_at);
        let hears = self.hears_more.then(Instant::now);
        gives_up.into_iter().chain(tells).chain(hears).min()
    }

    /// Takes what he says, but not all of who does not stop.
    pub(crate) fn hear(&mut self, board: &Board, player: Option<&dyn Playback>) -> Result<(), Gone> {
        self.hears_more = false;
        for _ in 0..HEARD {
            match self.socket.read() {
                Ok(Message::Text(text)) => self.obey(foxglove::parse(&text), board, player)?,
                Ok(Message::Close(_)) => return Err(Gone),
                Ok(_) => {}
                Err(Error::Io(error)) if error.kind() == io::ErrorKind::WouldBlock => return Ok(()),
                Err(_) => return Err(Gone),
            }
        }
        self.hears_more = true;
        Ok(())
    }

    fn obey(&mut self, wish: Option<Wish>, board: &Board, player: Option<&dyn Playback>) -> Result<(), Gone> {
        match wish {
            Some(Wish::Subscribe(wanted)) => {
                for (id, channel) in wanted {
                    if self.subscriptions.iter().any(|one| one.id == id) {
                        continue;
                    }
                    if self.subscriptions.len() >= SUBSCRIPTIONS {
                        return Err(Gone);
                    }
                    let Some(number) = board.subscribe(channel) else {
                        self.unknown = Some(channel);
                        continue;
                    };
                    self.subscriptions.push(Subscription { id, channel, number });
                }
            }
            Some(Wish::Unsubscribe(ids)) => {
                let (gone, left) = std::mem::take(&mut self.subscriptions)
                    .into_iter()
                    .partition(|one: &Subscription| ids.contains(&one.id));
                self.subscriptions = left;
                gone.iter().for_each(|one| board.unsubscribe(one.channel));
            }
            Some(Wish::Player(order)) => player.into_iter().for_each(|player| player.order(order)),
            None => {}
        }
        Ok(())
    }

    /// Sends what there is for him, until some of it has to wait: what came together in one piece.
    pub(crate) fn serve(&mut self, board: &Board, now: Instant) -> Result<(), Gone> {
        self.flush(now)?;
        while !self.is_pending() {
            if !self.gather(board, now)? {
                return Ok(());
            }
            self.flush(now)?;
        }
        Ok(())
    }

    /// Writes down what there is for him, in a piece that is not much longer than [`PIECE`]; whether there is any.
    fn gather(&mut self, board: &Board, now: Instant) -> Result<bool, Gone> {
        let mut length = 0;
        while length < PIECE {
            let channels = board.channels_from(self.told);
            if !channels.is_empty() {
                self.told += channels.len();
                length += PIECE;
                let told = foxglove::advertise(channels.iter().map(|(at, channel)| (*at, &**channel)));
                self.send(Message::text(told), now)?;
            } else if let Some(channel) = self.unknown.take() {
                length += PIECE;
                self.send(Message::text(foxglove::unknown_channel(channel)), now)?;
            } else if self.skipped > self.told_skipped && now >= self.tell_at {
                self.told_skipped = self.skipped;
                self.tell_at = now + TELL_EVERY;
                let words =
                    format!("{} messages skipped: newer ones came before they could be sent", self.skipped);
                length += PIECE;
                self.send(Message::text(foxglove::warning("skipped", &words)), now)?;
            } else if let Some((id, newest)) = self.choose(board) {
                let frame = foxglove::message(id, newest.wall_ns, &newest.payload);
                length += frame.len();
                self.send(Message::Binary(Bytes::from(frame)), now)?;
            } else {
                break;
            }
        }
        Ok(length > 0)
    }

    /// The next subscription for which there is something new, each in its turn.
    fn choose(&mut self, board: &Board) -> Option<(u32, Newest)> {
        let count = self.subscriptions.len();
        for step in 0..count {
            let at = (self.next + step) % count;
            let subscription = &mut self.subscriptions[at];
            let Some(newest) = board.newer(subscription.channel, subscription.number) else { continue };
            if !newest.is_kept {
                self.skipped += newest.number - subscription.number - 1;
            }
            subscription.number = newest.number;
            self.next = at + 1;
            return Some((subscription.id, newest));
        }
        None
    }

    /// Writes `message` down; some of it may be sent already.
    fn send(&mut self, message: Message, now: Instant) -> Result<(), Gone> {
        match self.socket.write(message) {
            Err(Error::Io(error)) if error.kind() != io::ErrorKind::WouldBlock => return Err(Gone),
            Ok(()) | Err(Error::Io(_)) => {}
            Err(_) => return Err(Gone),
        }
        self.pending.get_or_insert(now);
        Ok(())
    }

    fn flush(&mut self, now: Instant) -> Result<(), Gone> {
        let Some(since) = self.pending else { return Ok(()) };
        match self.socket.flush() {
            Ok(()) => self.pending = None,
            Err(Error::Io(error)) if error.kind() == io::ErrorKind::WouldBlock => {}
            Err(_) => return Err(Gone),
        }
        if self.is_pending() && now - since >= PATIENCE { Err(Gone) } else { Ok(()) }
    }

    /// He is gone.
    pub(crate) fn leave(&mut self, board: &Board) {
        self.subscriptions.drain(..).for_each(|one| board.unsubscribe(one.channel));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::board::Channel;
    use std::net::TcpListener;

    /// Both ends of a viewer.
    fn pair(now: Instant) -> (Viewer, WebSocket<TcpStream>) {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let client = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        client.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        let (server, _) = listener.accept().unwrap();
        server.set_nonblocking(true).unwrap();
        let viewer = Viewer::new(server, Vec::new(), "1", now).unwrap();
        (viewer, WebSocket::from_raw_socket(client, Role::Client, None))
    }

    #[test]
    fn who_does_not_read_gets_the_newest_then_and_hears_what_that_replaced() {
        let (board, now) = (Board::new().unwrap(), Instant::now());
        let scans = board.channel(Channel {
            topic: "/front/scan".into(),
            encoding: "cdr",
            schema_name: "S",
            schema_encoding: "ros2msg",
            schema: "",
            is_kept: false,
        });
        let (mut viewer, mut client) = pair(now);
        let subscribe = r#"{"op":"subscribe","subscriptions":[{"id":7,"channelId":1}]}"#;
        client.send(Message::text(subscribe)).unwrap();
        while !board.is_wanted(scans) {
            viewer.hear(&board, None).unwrap();
        }
        // Until the buffers of the system are full.
        let mut sent = 0_u32;
        let mut put = |viewer: &mut Viewer| {
            sent += 1;
            board.put(scans, 1, &[&sent.to_le_bytes()[..], &[0; 100_000]].concat());
            viewer.serve(&board, now).unwrap();
            sent
        };
        while !viewer.is_pending() {
            put(&mut viewer);
        }
        let full = put(&mut viewer);
        let last = (0..9).map(|_| put(&mut viewer)).last().unwrap();
        assert_eq!(last, full + 9);
        let (mut numbers, mut words) = (Vec::new(), String::new());
        while words.is_empty() || numbers.last() != Some(&last) {
            viewer.serve(&board, now).unwrap();
            match client.read().unwrap() {
                Message::Binary(frame) => numbers.push(u32::from_le_bytes(frame[13..17].try_into().unwrap())),
                Message::Text(text) if text.contains("skipped") => words = text.to_string(),
                _ => {}
            }
        }
        assert!(
            numbers.is_sorted() && numbers.len() as u64 + viewer.skipped() == u64::from(last),
            "{numbers:?}"
        );
        assert!(
            viewer.skipped() >= 9 && words.contains(&format!("{} messages", viewer.skipped())),
            "{words}"
        );
        // Who never reads is given up.
        while !viewer.is_pending() {
            put(&mut viewer);
        }
        assert!(viewer.serve(&board, now + PATIENCE).is_err());
    }
}
