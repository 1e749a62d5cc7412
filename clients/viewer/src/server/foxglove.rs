//! Messages of the protocol `foxglove.sdk.v1` between server and viewers (<https://github.com/foxglove/ws-protocol>).

use serde::{Deserialize, Serialize};

use super::channels::Channel;
use super::player::PlayerCommand;

/// Subprotocols of the WebSocket, the preferred one first. The second one is the former name of this protocol. Some
/// clients support only the former name (npm's `@foxglove/ws-protocol`, older versions of Lichtblick).
pub(crate) const PROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];

/// Returns the first message that the server sends to a viewer.
pub(crate) fn server_info(session: &str) -> String {
    text(&serde_json::json!({
        "op": "serverInfo",
        "name": format!("scanhub {}", env!("CARGO_PKG_VERSION")),
        "capabilities": [],
        "metadata": {},
        "sessionId": session,
    }))
}

/// Returns the message that advertises channels with their IDs.
pub(crate) fn advertise<'a>(channels: impl Iterator<Item = (usize, &'a Channel)>) -> String {
    #[derive(Serialize)]
    #[serde(rename_all = "camelCase")]
    struct AdvertisedChannel<'a> {
        id: usize,
        topic: &'a str,
        encoding: &'a str,
        schema_name: &'a str,
        schema: &'a str,
        schema_encoding: &'a str,
    }
    let channels: Vec<_> = channels
        .map(|(at, channel)| AdvertisedChannel {
            id: at + 1,
            topic: &channel.topic,
            encoding: channel.encoding,
            schema_name: channel.schema_name,
            schema: channel.schema,
            schema_encoding: channel.schema_encoding,
        })
        .collect();
    text(&serde_json::json!({ "op": "advertise", "channels": channels }))
}

/// Returns the error message for a subscription to a channel that does not exist.
pub(crate) fn unknown_channel(at: usize) -> String {
    const ERROR: u8 = 2;
    let message = format!("Unknown channel ID: {}", at.wrapping_add(1));
    text(&serde_json::json!({ "op": "status", "level": ERROR, "message": message }))
}

/// Returns a warning, which viewers show until the next warning with this `id`.
pub(crate) fn warning(id: &str, message: &str) -> String {
    const WARNING: u8 = 1;
    text(&serde_json::json!({ "op": "status", "level": WARNING, "message": message, "id": id }))
}

/// Returns a message for a subscription. `wall_ns` is the time of the message in ns since 1970.
pub(crate) fn message(subscription: u32, wall_ns: u64, payload: &[u8]) -> Vec<u8> {
    const MESSAGE_DATA: u8 = 1;
    let mut frame = Vec::with_capacity(13 + payload.len());
    frame.push(MESSAGE_DATA);
    frame.extend(subscription.to_le_bytes());
    frame.extend(wall_ns.to_le_bytes());
    frame.extend(payload);
    frame
}

/// Message from a viewer.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum ClientMessage {
    /// Subscribe to channels: ID of each subscription, and index of its channel.
    Subscribe(Vec<(u32, usize)>),
    /// End these subscriptions.
    Unsubscribe(Vec<u32>),
    /// Control the player. The protocol's own player messages have neither single steps nor doubling of the rate.
    Player(PlayerCommand),
}

/// Parses a message from a viewer. Returns `None` if the message is invalid, or requires a capability that this server
/// does not have.
pub(crate) fn parse(text: &str) -> Option<ClientMessage> {
    #[derive(Deserialize)]
    #[serde(tag = "op", rename_all = "camelCase")]
    enum Op {
        Subscribe {
            subscriptions: Vec<Subscription>,
        },
        #[serde(rename_all = "camelCase")]
        Unsubscribe {
            subscription_ids: Vec<u32>,
        },
        #[serde(rename = "scanhub.player")]
        Player {
            order: PlayerCommand,
        },
    }
    #[derive(Deserialize)]
    #[serde(rename_all = "camelCase")]
    struct Subscription {
        id: u32,
        channel_id: usize,
    }
    Some(match serde_json::from_str(text).ok()? {
        Op::Subscribe { subscriptions } => {
            // IDs of channels start at 1.
            let index = |one: Subscription| (one.id, one.channel_id.wrapping_sub(1));
            ClientMessage::Subscribe(subscriptions.into_iter().map(index).collect())
        }
        Op::Unsubscribe { subscription_ids } => ClientMessage::Unsubscribe(subscription_ids),
        Op::Player { order } => ClientMessage::Player(order),
    })
}

fn text(value: &impl Serialize) -> String {
    serde_json::to_string(value).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_client_messages_and_ignores_others() {
        let subscribe =
            r#"{"op":"subscribe","subscriptions":[{"id":7,"channelId":1},{"id":8,"channelId":0}]}"#;
        assert_eq!(parse(subscribe), Some(ClientMessage::Subscribe(vec![(7, 0), (8, usize::MAX)])));
        let unsubscribe = r#"{"op":"unsubscribe","subscriptionIds":[7]}"#;
        assert_eq!(parse(unsubscribe), Some(ClientMessage::Unsubscribe(vec![7])));
        let step = r#"{"op":"scanhub.player","order":"step"}"#;
        assert_eq!(parse(step), Some(ClientMessage::Player(PlayerCommand::Step)));
        let deep = "[".repeat(100_000);
        for other in ["", "{}", r#"{"op":"getParameters"}"#, r#"{"op":"subscribe"}"#, &deep] {
            assert_eq!(parse(other), None);
        }
    }

    /// The expected messages were recorded from a server of PyPI's foxglove-sdk 0.30.3, with the same channel and
    /// message.
    #[test]
    fn messages_equal_those_of_the_foxglove_sdk() {
        let channel = Channel {
            topic: "/front/status".into(),
            encoding: "json",
            schema_name: "scanhub.Status",
            schema_encoding: "jsonschema",
            schema: r#"{"type":"object"}"#,
            is_kept: true,
        };
        let value = |text: &str| serde_json::from_str::<serde_json::Value>(text).unwrap();
        let theirs = r#"{"op":"advertise","channels":[{"id":1,"topic":"/front/status","encoding":"json",
            "schemaName":"scanhub.Status","schemaEncoding":"jsonschema","schema":"{\"type\":\"object\"}"}]}"#;
        assert_eq!(value(&advertise([(0, &channel)].into_iter())), value(theirs));
        let theirs = r#"{"op":"status","level":2,"message":"Unknown channel ID: 99"}"#;
        assert_eq!(value(&unknown_channel(98)), value(theirs));
        let theirs = "01070000001581e97df41022117b2261223a317d";
        let ours = message(7, 1_234_567_890_123_456_789, br#"{"a":1}"#);
        assert_eq!(ours.iter().map(|byte| format!("{byte:02x}")).collect::<String>(), theirs);
        let keys = |text: &str| value(text).as_object().unwrap().keys().cloned().collect::<Vec<_>>();
        let theirs =
            r#"{"op":"serverInfo","name":"","capabilities":[],"metadata":{},"sessionId":"1795475253384"}"#;
        assert_eq!(keys(&server_info("1")), keys(theirs));
    }

    #[test]
    fn server_messages_have_the_keys_of_the_protocol() {
        let channel = Channel {
            topic: "/front/scan".into(),
            encoding: "cdr",
            schema_name: "sensor_msgs/msg/LaserScan",
            schema_encoding: "ros2msg",
            schema: "x",
            is_kept: false,
        };
        let advertised: serde_json::Value =
            serde_json::from_str(&advertise([(0, &channel)].into_iter())).unwrap();
        let channels = serde_json::json!([{"id": 1, "topic": "/front/scan", "encoding": "cdr",
            "schemaName": "sensor_msgs/msg/LaserScan", "schema": "x", "schemaEncoding": "ros2msg"}]);
        assert_eq!((&advertised["op"], &advertised["channels"]), (&"advertise".into(), &channels));
        let info: serde_json::Value = serde_json::from_str(&server_info("5")).unwrap();
        assert_eq!((&info["op"], &info["sessionId"]), (&"serverInfo".into(), &"5".into()));
        assert_eq!(message(0x0403_0201, 9, b"ab"), [1, 1, 2, 3, 4, 9, 0, 0, 0, 0, 0, 0, 0, b'a', b'b']);
    }
}
