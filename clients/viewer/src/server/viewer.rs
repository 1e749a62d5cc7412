//! One viewer: the WebSocket, the subscriptions, and the choice of the next message. Few bytes are in flight, so memory
//! is limited. A viewer that was slow continues with the newest messages.

use std::io;
use std::net::TcpStream;
use std::time::{Duration, Instant};

use tungstenite::protocol::{Role, WebSocketConfig};
use tungstenite::{Bytes, Error, Message, WebSocket};

use super::channels::{ChannelStore, QueuedMessage};
use super::foxglove::{self, ClientMessage};
use super::player::Playback;

/// Maximum number of subscriptions of a viewer.
const MAX_SUBSCRIPTIONS: usize = 256;
/// Maximum length of a message from a viewer, in bytes: enough to subscribe to everything.
const MAX_MESSAGE_LEN: usize = 64 << 10;
/// Maximum number of messages from a viewer that are handled in one call, so that a flood does not starve other
/// viewers.
const BATCH_SIZE: usize = 32;
/// Number of bytes that are collected before they are written. With this size, many small messages need few system
/// calls, and little data is in flight.
const WRITE_SIZE: usize = 16 << 10;
/// Send timeout. A viewer that does not accept a message in this time is disconnected.
const SEND_TIMEOUT: Duration = Duration::from_secs(30);
/// Minimum interval between two reports of replaced messages.
const REPORT_INTERVAL: Duration = Duration::from_secs(1);

/// A connected viewer.
pub(crate) struct Viewer {
    socket: WebSocket<TcpStream>,
    subscriptions: Vec<Subscription>,
    /// Number of channels that were advertised.
    advertised: usize,
    /// Index of the subscription that is served next.
    next: usize,
    /// Time since which the socket has been full; `None` if it has accepted all bytes.
    pending: Option<Instant>,
    /// Whether the socket was full at any time since this viewer last had received all messages.
    was_full: bool,
    replaced: ReplacedMessages,
    reported: ReplacedMessages,
    report_at: Instant,
    /// Unknown channel to which the viewer subscribed last; `None` once the error message was sent.
    unknown_channel: Option<usize>,
    /// Whether messages that have already arrived may still be unread, so that the socket does not report them again.
    has_unread: bool,
}

struct Subscription {
    id: u32,
    channel: usize,
    /// Number of the last message that was sent. Before the first message, number of the last message before the
    /// subscription.
    number: u64,
}

/// Counts of messages that newer messages replaced before they could be sent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct ReplacedMessages {
    /// Number of messages that were replaced because the viewer or its network was too slow.
    by_viewer: u64,
    /// Number of messages that were replaced because this process was delayed.
    by_server: u64,
}

/// Error: the viewer has disconnected, or must be disconnected.
#[derive(Debug)]
pub(crate) struct Disconnected;

impl Viewer {
    /// Creates a viewer after its handshake. `early` has the bytes that the viewer has already sent after its
    /// handshake.
    pub(crate) fn new(
        stream: TcpStream,
        early: Vec<u8>,
        session: &str,
        now: Instant,
    ) -> Result<Viewer, Disconnected> {
        let config = WebSocketConfig::default()
            .read_buffer_size(4096)
            .write_buffer_size(2 * WRITE_SIZE)
            .max_message_size(Some(MAX_MESSAGE_LEN))
            .max_frame_size(Some(MAX_MESSAGE_LEN));
        let mut viewer = Viewer {
            socket: WebSocket::from_partially_read(stream, early, Role::Server, Some(config)),
            subscriptions: Vec::new(),
            advertised: 0,
            next: 0,
            pending: None,
            was_full: false,
            replaced: ReplacedMessages::default(),
            reported: ReplacedMessages::default(),
            report_at: now,
            unknown_channel: None,
            has_unread: true,
        };
        viewer.send(Message::text(foxglove::server_info(session)), now)?;
        viewer.flush(now)?;
        Ok(viewer)
    }

    pub(crate) fn stream(&self) -> &TcpStream {
        self.socket.get_ref()
    }

    /// Returns whether bytes wait because the socket is full.
    pub(crate) fn is_pending(&self) -> bool {
        self.pending.is_some()
    }

    /// Returns the number of messages that newer messages replaced before they could be sent. Messages that are a state
    /// do not count.
    pub(crate) fn replaced_count(&self) -> u64 {
        self.replaced.by_viewer + self.replaced.by_server
    }

    /// Returns whether [`receive`](Self::receive) may have left messages unread.
    pub(crate) fn has_unread_messages(&self) -> bool {
        self.has_unread
    }

    /// Returns the time at which the viewer must be served even if no input arrives, for example for a timeout.
    pub(crate) fn wake_at(&self) -> Option<Instant> {
        let times_out = self.pending.map(|since| since + SEND_TIMEOUT);
        let reports = (self.replaced != self.reported).then_some(self.report_at);
        let reads = self.has_unread.then(Instant::now);
        times_out.into_iter().chain(reports).chain(reads).min()
    }

    /// Handles messages from the viewer, up to [`BATCH_SIZE`].
    pub(crate) fn receive(
        &mut self,
        channels: &ChannelStore,
        player: Option<&dyn Playback>,
    ) -> Result<(), Disconnected> {
        self.has_unread = false;
        for _ in 0..BATCH_SIZE {
            match self.socket.read() {
                Ok(Message::Text(text)) => self.handle_message(foxglove::parse(&text), channels, player)?,
                Ok(Message::Close(_)) => return Err(Disconnected),
                Ok(_) => {}
                Err(Error::Io(error)) if error.kind() == io::ErrorKind::WouldBlock => return Ok(()),
                Err(_) => return Err(Disconnected),
            }
        }
        self.has_unread = true;
        Ok(())
    }

    fn handle_message(
        &mut self,
        message: Option<ClientMessage>,
        channels: &ChannelStore,
        player: Option<&dyn Playback>,
    ) -> Result<(), Disconnected> {
        match message {
            Some(ClientMessage::Subscribe(requested)) => {
                for (id, channel) in requested {
                    if self.subscriptions.iter().any(|one| one.id == id) {
                        continue;
                    }
                    if self.subscriptions.len() >= MAX_SUBSCRIPTIONS {
                        return Err(Disconnected);
                    }
                    let Some(number) = channels.subscribe(channel) else {
                        self.unknown_channel = Some(channel);
                        continue;
                    };
                    self.subscriptions.push(Subscription { id, channel, number });
                }
            }
            Some(ClientMessage::Unsubscribe(ids)) => {
                let (removed, left) = std::mem::take(&mut self.subscriptions)
                    .into_iter()
                    .partition(|one: &Subscription| ids.contains(&one.id));
                self.subscriptions = left;
                removed.iter().for_each(|one| channels.unsubscribe(one.channel));
            }
            Some(ClientMessage::Player(command)) => {
                player.into_iter().for_each(|player| player.command(command))
            }
            None => {}
        }
        Ok(())
    }

    /// Sends messages until no message is left, or the socket is full.
    pub(crate) fn serve(&mut self, channels: &ChannelStore, now: Instant) -> Result<(), Disconnected> {
        self.flush(now)?;
        while !self.is_pending() {
            if !self.gather(channels, now)? {
                return Ok(());
            }
            self.flush(now)?;
        }
        Ok(())
    }

    /// Buffers about [`WRITE_SIZE`] bytes for the viewer. Returns whether any bytes were buffered.
    fn gather(&mut self, channels: &ChannelStore, now: Instant) -> Result<bool, Disconnected> {
        let mut length = 0;
        while length < WRITE_SIZE {
            let new = channels.channels_from(self.advertised);
            if !new.is_empty() {
                self.advertised += new.len();
                length += WRITE_SIZE;
                let advertisement = foxglove::advertise(new.iter().map(|(at, channel)| (*at, &**channel)));
                self.send(Message::text(advertisement), now)?;
            } else if let Some(channel) = self.unknown_channel.take() {
                length += WRITE_SIZE;
                self.send(Message::text(foxglove::unknown_channel(channel)), now)?;
            } else if self.replaced != self.reported && now >= self.report_at {
                self.reported = self.replaced;
                self.report_at = now + REPORT_INTERVAL;
                length += WRITE_SIZE;
                self.send(Message::text(foxglove::warning("skipped", &self.replaced.text())), now)?;
            } else if let Some((id, queued)) = self.choose(channels) {
                let frame = foxglove::message(id, queued.wall_ns, &queued.payload);
                length += frame.len();
                self.send(Message::Binary(Bytes::from(frame)), now)?;
            } else {
                break;
            }
        }
        Ok(length > 0)
    }

    /// Returns the next message and its subscription. Subscriptions take turns.
    fn choose(&mut self, channels: &ChannelStore) -> Option<(u32, QueuedMessage)> {
        let count = self.subscriptions.len();
        for step in 0..count {
            let at = (self.next + step) % count;
            let subscription = &mut self.subscriptions[at];
            let Some(queued) = channels.next(subscription.channel, subscription.number) else { continue };
            if !queued.is_kept {
                let replaced = queued.number - subscription.number - 1;
                let ReplacedMessages { by_viewer, by_server } = &mut self.replaced;
                *(if self.was_full { by_viewer } else { by_server }) += replaced;
            }
            subscription.number = queued.number;
            self.next = at + 1;
            return Some((subscription.id, queued));
        }
        self.was_full = false;
        None
    }

    /// Buffers `message`, and may send a part of the buffer.
    fn send(&mut self, message: Message, now: Instant) -> Result<(), Disconnected> {
        match self.socket.write(message) {
            Err(Error::Io(error)) if error.kind() != io::ErrorKind::WouldBlock => return Err(Disconnected),
            Ok(()) | Err(Error::Io(_)) => {}
            Err(_) => return Err(Disconnected),
        }
        self.pending.get_or_insert(now);
        Ok(())
    }

    fn flush(&mut self, now: Instant) -> Result<(), Disconnected> {
        let Some(since) = self.pending else { return Ok(()) };
        match self.socket.flush() {
            Ok(()) => self.pending = None,
            Err(Error::Io(error)) if error.kind() == io::ErrorKind::WouldBlock => self.was_full = true,
            Err(_) => return Err(Disconnected),
        }
        if self.is_pending() && now - since >= SEND_TIMEOUT { Err(Disconnected) } else { Ok(()) }
    }

    /// Ends the subscriptions.
    pub(crate) fn unsubscribe_all(&mut self, channels: &ChannelStore) {
        self.subscriptions.drain(..).for_each(|one| channels.unsubscribe(one.channel));
    }
}

impl ReplacedMessages {
    /// Returns the report for the viewer.
    fn text(self) -> String {
        let ReplacedMessages { by_viewer, by_server } = self;
        let viewer = format!("{by_viewer} messages missed: this viewer or its network is too slow");
        let server = format!("{by_server} messages missed: the server was too late, its machine may be busy");
        match (by_viewer, by_server) {
            (_, 0) => viewer,
            (0, _) => server,
            _ => format!("{viewer}; {server}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::Channel;
    use std::net::TcpListener;

    /// Returns both ends of a viewer's connection.
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
    fn slow_viewer_gets_newest_message_and_skipped_count() {
        let (channels, now) = (ChannelStore::new().unwrap(), Instant::now());
        let scans = channels.open(Channel {
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
        while !scans.is_needed() {
            viewer.receive(&channels, None).unwrap();
        }
        let publish = |number: u32| {
            scans.publish(1, &[&number.to_le_bytes()[..], &[0; 100_000]].concat());
        };
        let mut receive = || match client.read().unwrap() {
            Message::Binary(frame) => Ok(u32::from_le_bytes(frame[13..17].try_into().unwrap())),
            Message::Text(text) => Err(text.to_string()),
            other => panic!("{other:?}"),
        };
        // The server is late, and the queue is too short.
        (1..=40).for_each(publish);
        viewer.serve(&channels, now).unwrap();
        let (newest, report) = loop {
            match receive() {
                Ok(number) => break (number, receive().unwrap_err()),
                Err(other) => assert!(!other.contains("messages missed"), "{other}"),
            }
        };
        assert_eq!((newest, viewer.replaced_count()), (40, 39));
        assert!(report.contains("39 messages missed: the server was too late"), "{report}");
        // The viewer does not read, so the buffers of the sockets fill.
        let (mut last, now) = (40, now + REPORT_INTERVAL);
        while !viewer.is_pending() {
            last += 1;
            publish(last);
            viewer.serve(&channels, now).unwrap();
        }
        for _ in 0..40 {
            last += 1;
            publish(last);
            viewer.serve(&channels, now).unwrap();
        }
        let (mut numbers, mut report) = (vec![newest], String::new());
        while report.is_empty() || numbers.last() != Some(&last) {
            viewer.serve(&channels, now).unwrap();
            match receive() {
                Ok(number) => numbers.push(number),
                Err(text) => report = text,
            }
        }
        let received = numbers.len() as u64;
        assert!(numbers.is_sorted() && received + viewer.replaced_count() == u64::from(last), "{numbers:?}");
        let expected = format!("{} messages missed: this viewer", viewer.replaced_count() - 39);
        assert!(viewer.replaced_count() > 39 && report.contains(&expected), "{report}");
        // A viewer that never reads is disconnected.
        while !viewer.is_pending() {
            last += 1;
            publish(last);
            viewer.serve(&channels, now).unwrap();
        }
        assert!(viewer.serve(&channels, now + SEND_TIMEOUT).is_err());
    }
}
