//! Test that other viewers miss no message because of a slow viewer and many connections. The next message is published
//! when all readers have the previous one, so the test does not depend on the speed of the machine.

use std::net::{SocketAddr, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use scanhub_viewer::server::{
    AccessPolicy, Channel, ChannelPublisher, ChannelStore, Event, MAX_VIEWERS, Server,
};
use serde_json::json;
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};

/// Timeout for a message. A message takes far less time.
const TIMEOUT: Duration = Duration::from_secs(60);
/// Number of messages. Together, the messages are longer than the system's buffers.
const MESSAGE_COUNT: u32 = 400;
const MESSAGE_LEN: usize = 20_000;
/// Number of viewers that read.
const READER_COUNT: usize = 16;

fn channel(topic: &str, is_kept: bool) -> Channel {
    Channel {
        topic: topic.to_owned(),
        encoding: "json",
        schema_name: "S",
        schema_encoding: "jsonschema",
        schema: "{}",
        is_kept,
    }
}

fn connect_viewer(address: SocketAddr) -> WebSocket<TcpStream> {
    let mut request = format!("ws://{address}/").into_client_request().unwrap();
    request.headers_mut().insert("Sec-WebSocket-Protocol", "foxglove.sdk.v1".parse().unwrap());
    let stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(TIMEOUT)).unwrap();
    tungstenite::client(request, stream).unwrap().0
}

/// Returns the subscription ID and the body of the next message.
fn next_message(viewer: &mut WebSocket<TcpStream>) -> (u32, Vec<u8>) {
    loop {
        if let Message::Binary(frame) = viewer.read().unwrap() {
            return (u32::from_le_bytes(frame[1..5].try_into().unwrap()), frame[13..].to_vec());
        }
    }
}

/// Subscribes to both channels, and waits for the last state. The server sends the last state at once.
fn subscribe(viewer: &mut WebSocket<TcpStream>) {
    let both: Vec<_> = (1..=2).map(|id| json!({ "id": id, "channelId": id })).collect();
    let wish = json!({ "op": "subscribe", "subscriptions": both });
    viewer.send(Message::text(wish.to_string())).unwrap();
    assert_eq!(next_message(viewer).0, 2);
}

/// Publishes message `number` of `scans`.
fn publish(channels: &ChannelStore, scans: ChannelPublisher<'_>, number: u32) {
    let mut payload = vec![0; MESSAGE_LEN];
    payload[..4].copy_from_slice(&number.to_le_bytes());
    scans.publish(1, &payload);
    channels.wake_if_new();
}

/// Returns the number in a message of the subscription with ID 1.
fn number((subscription, body): (u32, Vec<u8>)) -> u32 {
    assert_eq!(subscription, 1);
    u32::from_le_bytes(body[..4].try_into().unwrap())
}

/// Guard that ends the server even if the test fails.
struct CloseOnDrop<'a>(&'a AtomicBool, &'a ChannelStore);

impl Drop for CloseOnDrop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
        self.1.wake();
    }
}

#[test]
fn readers_get_every_message_despite_a_slow_viewer() {
    let (channels, stop) = (ChannelStore::new().unwrap(), AtomicBool::new(false));
    let scans = channels.open(channel("/front/scan", false));
    let status = channels.open(channel("/front/status", true));
    status.publish(1, b"{}");
    let server = Server::bind("127.0.0.1:0".parse().unwrap(), AccessPolicy::default()).unwrap();
    let (tell, events) = mpsc::channel();
    thread::scope(|scope| {
        let served = scope.spawn(|| server.run(&channels, None, &tell, &stop));
        let closing = CloseOnDrop(&stop, &channels);
        let mut slow = connect_viewer(server.address());
        subscribe(&mut slow);
        let mut readers: Vec<_> = (0..READER_COUNT).map(|_| connect_viewer(server.address())).collect();
        readers.iter_mut().for_each(subscribe);
        let _rest: Vec<_> =
            (readers.len() + 1..MAX_VIEWERS).map(|_| connect_viewer(server.address())).collect();
        let _idle: Vec<_> = (0..150).map(|_| TcpStream::connect(server.address()).unwrap()).collect();
        for sent in 1..=MESSAGE_COUNT {
            publish(&channels, scans, sent);
            for reader in &mut readers {
                assert_eq!(number(next_message(reader)), sent);
            }
        }
        // The slow viewer gets the last message, and misses most of the others.
        let mut got = vec![number(next_message(&mut slow))];
        while got.last() != Some(&MESSAGE_COUNT) {
            got.push(number(next_message(&mut slow)));
        }
        assert!(
            got.is_sorted() && got.len() < MESSAGE_COUNT as usize / 2,
            "{} of {MESSAGE_COUNT}",
            got.len()
        );
        drop((slow, readers));
        let next_event = || events.recv_timeout(TIMEOUT).unwrap();
        let mut replaced_counts = Vec::new();
        while replaced_counts.len() <= READER_COUNT {
            if let Event::Viewer(visit) = next_event()
                && !visit.connected
            {
                replaced_counts.push(visit.replaced);
            }
        }
        replaced_counts.sort_unstable();
        let slow_viewer_replaced = replaced_counts.pop();
        assert_eq!(
            slow_viewer_replaced,
            Some(u64::from(MESSAGE_COUNT) - got.len() as u64),
            "replaced messages are counted"
        );
        assert!(replaced_counts.iter().all(|replaced| *replaced == 0), "{replaced_counts:?}");
        drop(closing);
        served.join().unwrap().unwrap();
    });
}

#[test]
fn every_server_has_its_own_session() {
    let sessions: Vec<_> = (0..2)
        .map(|_| {
            let (channels, stop) = (ChannelStore::new().unwrap(), AtomicBool::new(false));
            let server = Server::bind("127.0.0.1:0".parse().unwrap(), AccessPolicy::default()).unwrap();
            let (tell, _events) = mpsc::channel();
            thread::scope(|scope| {
                scope.spawn(|| server.run(&channels, None, &tell, &stop));
                let _closing = CloseOnDrop(&stop, &channels);
                let text = connect_viewer(server.address()).read().unwrap().to_string();
                let server_info: serde_json::Value = serde_json::from_str(&text).unwrap();
                server_info["sessionId"].as_str().unwrap().to_owned()
            })
        })
        .collect();
    // 128 random bits are never equal by chance.
    assert!(sessions[0] != sessions[1] && sessions.iter().all(|one| one.len() == 32), "{sessions:?}");
}
