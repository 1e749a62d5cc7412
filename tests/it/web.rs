//! Tests of the server of `web`, with viewers and with clients that have no access. They check Foxglove's protocol,
//! access control, and the maximum number of viewers.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Instant;

use crate::testkit::{INT, Program, TestEnv, WAIT_TIMEOUT, is_class, wait_until};
use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};

/// Starts a server with these flags, and returns the server and its address as `HOST:PORT`.
pub(crate) fn web(env: &TestEnv, flags: &[&str]) -> (Program, String) {
    let mut server = env.start(&[&["web", "--json", "--listen", "127.0.0.1:0"], flags].concat());
    let ready = server.await_line("the address of the page", is_class("ready"));
    let url = ready["url"].as_str().expect("an address");
    let host = url.trim_start_matches("http://").split('/').next().expect("a host").to_owned();
    (server, host)
}

pub(crate) fn connect(host: &str) -> TcpStream {
    let stream = TcpStream::connect(host).expect("the server listens");
    stream.set_read_timeout(Some(WAIT_TIMEOUT)).expect("a timeout");
    stream
}

/// Returns the server's response to `head`, or an empty string if it sends none.
pub(crate) fn send_request(host: &str, head: &str) -> String {
    let mut stream = connect(host);
    stream.write_all(head.as_bytes()).expect("a sent request");
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    String::from_utf8_lossy(&answer).into_owned()
}

pub(crate) fn status(response: &str) -> &str {
    response.split(' ').nth(1).unwrap_or("none")
}

/// Connects a viewer. Returns the HTTP status if the server refuses it.
pub(crate) fn connect_viewer(
    host: &str,
    path: &str,
    origin: Option<&str>,
) -> Result<WebSocket<TcpStream>, u16> {
    connect_viewer_with(host, path, origin, "foxglove.sdk.v1")
}

/// Connects like [`connect_viewer`], with `protocol` as the name of the WebSocket protocol.
pub(crate) fn connect_viewer_with(
    host: &str,
    path: &str,
    origin: Option<&str>,
    protocol: &str,
) -> Result<WebSocket<TcpStream>, u16> {
    let mut request = format!("ws://{host}{path}").into_client_request().expect("an address");
    let headers = request.headers_mut();
    headers.insert("Sec-WebSocket-Protocol", protocol.parse().expect("a header"));
    if let Some(origin) = origin {
        headers.insert("Origin", origin.parse().expect("a header"));
    }
    match tungstenite::client(request, connect(host)) {
        Ok((socket, _)) => Ok(socket),
        Err(tungstenite::HandshakeError::Failure(tungstenite::Error::Http(answer))) => {
            Err(answer.status().as_u16())
        }
        Err(other) => panic!("{other}"),
    }
}

pub(crate) fn text(socket: &mut WebSocket<TcpStream>) -> Value {
    loop {
        if let Message::Text(text) = socket.read().expect("an open connection") {
            return serde_json::from_str(&text).expect("JSON");
        }
    }
}

/// Waits until the channels of `topics` are advertised, and returns them. Discards other messages.
pub(crate) fn channels<const N: usize>(viewer: &mut WebSocket<TcpStream>, topics: [&str; N]) -> [Value; N] {
    let give_up_at = Instant::now() + WAIT_TIMEOUT;
    let mut advertised: Vec<Value> = Vec::new();
    let of = |advertised: &[Value], topic: &str| {
        advertised.iter().find(|channel| channel["topic"] == topic).cloned()
    };
    while !topics.iter().all(|topic| of(&advertised, topic).is_some()) {
        assert!(Instant::now() < give_up_at, "{topics:?} are not all in {advertised:?}");
        advertised.extend(text(viewer)["channels"].as_array().into_iter().flatten().cloned());
    }
    topics.map(|topic| of(&advertised, topic).expect("an advertised channel"))
}

/// Subscribes to channels. Each item of `requested` has the ID of the new subscription and the ID of the channel.
pub(crate) fn subscribe(viewer: &mut WebSocket<TcpStream>, requested: &[(u32, &Value)]) {
    let expected: Vec<_> =
        requested.iter().map(|(number, id)| json!({ "id": number, "channelId": id })).collect();
    let wish = json!({ "op": "subscribe", "subscriptions": expected });
    viewer.send(Message::text(wish.to_string())).expect("a sent message");
}

#[test]
fn foreign_hosts_and_origins_are_refused() {
    let env = TestEnv::new();
    let (_open, host) = web(&env, &[]);
    let get = |host: &str, name: &str, more: &str| {
        send_request(host, &format!("GET / HTTP/1.1\r\nHost: {name}\r\n{more}\r\n"))
    };
    let page = get(&host, &host, "");
    assert_eq!(status(&page), "200");
    for header in ["nosniff", "no-store", "default-src 'none'", "frame-ancestors 'none'", "no-referrer"] {
        assert!(page.contains(header), "{header}");
    }
    assert_eq!(status(&get(&host, "evil.example", "")), "403");
    assert_eq!(status(&get(&host, &host, "Origin: http://evil.example\r\n")), "403");
    assert_eq!(connect_viewer(&host, "/", Some("https://evil.example")).err(), Some(403));
    assert!(connect_viewer(&host, "/", None).is_ok());
    assert_eq!(connect_viewer_with(&host, "/", None, "chat").err(), Some(400));
    assert_eq!(status(&send_request(&host, &format!("POST / HTTP/1.1\r\nHost: {host}\r\n\r\n"))), "405");
    assert_eq!(
        status(&send_request(&host, &format!("GET /etc/passwd HTTP/1.1\r\nHost: {host}\r\n\r\n"))),
        "404"
    );
    assert_eq!(send_request(&host, "\x16\x03\x01 no request\r\n\r\n"), "");
    assert_eq!(send_request(&host, &format!("GET /{}", "a".repeat(9000))), "");

    let (_closed, host) = web(&env, &["--token", "carrot", "--allow-origin", "https://viewer.example"]);
    assert_eq!(status(&get(&host, &host, "")), "401");
    assert_eq!(status(&get(&host, &host, "Authorization: Bearer carrot\r\n")), "200");
    assert_eq!(connect_viewer(&host, "/", None).err(), Some(401));
    assert_eq!(connect_viewer(&host, "/?token=carro", None).err(), Some(401));
    assert!(connect_viewer(&host, "/?token=carrot", Some("https://viewer.example")).is_ok());

    let outcome = env.run(&["web", "--listen", "0.0.0.0:0"]);
    assert_eq!(outcome.exit_code, Some(2), "{outcome}");
    assert!(outcome.stderr.contains("--token"), "{outcome}");
}

#[test]
fn viewer_gets_foxglove_messages_despite_hostile_one() {
    let env = TestEnv::new();
    let _sensor = env.simulator(&["front"], &["--seed=5", "--baud=500000"]);
    let _hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    let (mut server, host) = web(&env, &[]);
    let mut viewer = connect_viewer(&host, "/", None).expect("an accepted viewer");
    server.await_line("a connected viewer", |line| line["class"] == "viewer" && line["connected"] == true);
    assert_eq!(text(&mut viewer)["op"], "serverInfo");
    // The next viewer sends hostile frames, which must not affect the first viewer.
    let mut hostile = connect_viewer(&host, "/", None).expect("an accepted viewer");
    hostile.send(Message::text("[".repeat(60_000))).expect("a sent message");
    hostile.send(Message::binary(vec![1; 60_000])).expect("a sent message");
    let _ = hostile.send(Message::binary(vec![1; 1 << 20]));

    let [scan, zones, _] = channels(&mut viewer, ["/front/scan", "/zones", "/front/status"]);
    assert_eq!(
        [&scan["encoding"], &scan["schemaName"], &scan["schemaEncoding"]],
        ["cdr", "sensor_msgs/msg/LaserScan", "ros2msg"]
    );
    assert_eq!([&zones["encoding"], &zones["schemaName"]], ["json", "foxglove.SceneUpdate"]);
    subscribe(&mut viewer, &[(70, &scan["id"]), (71, &zones["id"]), (72, &9999.into())]);
    let give_up_at = Instant::now() + WAIT_TIMEOUT;
    let mut received = [0_u32; 2];
    while received.iter().any(|count| *count < 5) {
        assert!(Instant::now() < give_up_at, "{received:?}");
        let Message::Binary(frame) = viewer.read().expect("an open connection") else { continue };
        let subscription = u32::from_le_bytes(frame[1..5].try_into().expect("four bytes"));
        assert_eq!(frame[0], 1);
        let body = &frame[13..];
        match subscription {
            70 => {
                let message = scanhub_ros::read(&scanhub_ros::LASER_SCAN, body).expect("a LaserScan");
                assert_eq!(message.text("header.frame_id"), Some("front"));
                assert!(message.number("ranges.0").is_some());
                received[0] += 1;
            }
            71 => {
                let message: Value = serde_json::from_slice(body).expect("a SceneUpdate");
                received[1] += u32::from(message["entities"].as_array().is_some_and(|all| all.len() >= 2));
            }
            other => panic!("no subscription {other}"),
        }
    }
    drop(viewer);
    server
        .await_line("a disconnected viewer", |line| line["class"] == "viewer" && line["connected"] == false);
    assert_eq!(server.end(INT).exit_code, Some(0));
}

#[test]
fn viewers_beyond_the_limit_are_refused() {
    let env = TestEnv::new();
    let (server, host) = web(&env, &[]);
    let mut viewers: Vec<_> =
        (0..32).map(|_| connect_viewer(&host, "/", None).expect("an accepted viewer")).collect();
    assert_eq!(connect_viewer(&host, "/", None).err(), Some(503));
    // Connections without a request do not count as viewers, and the page is still served.
    let idle: Vec<_> = (0..20).map(|_| connect(&host)).collect();
    assert_eq!(status(&send_request(&host, &format!("GET / HTTP/1.1\r\nHost: {host}\r\n\r\n"))), "200");
    drop(idle);
    let _ = viewers.pop().map(|mut one| one.close(None));
    wait_until("a free slot for a viewer", || connect_viewer(&host, "/", None).is_ok());
    assert_eq!(server.end(INT).exit_code, Some(0));
}

#[test]
fn web_uses_the_next_port_if_one_is_in_use() {
    let env = TestEnv::new();
    let (_first, host) = web(&env, &[]);
    let mut second = env.start(&["web", "--json", "--listen", &host]);
    let ready = second.await_line("the address of the page", is_class("ready"));
    let port =
        |text: &str| text.trim_end_matches('/').rsplit(':').next().and_then(|port| port.parse::<u16>().ok());
    let (first, second) = (port(&host), port(ready["url"].as_str().expect("an address")));
    assert!(first < second && second <= first.map(|port| port + 20), "{first:?} {second:?}");
}
