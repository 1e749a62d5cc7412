//! A viewer without a picture: it subscribes to what the page does, reads as fast as it can and counts. Refuses to know what
//! comes.

use std::net::TcpStream;
use std::thread;
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};

use super::support::Outcome;

/// Reads what comes at `url` for `span`, without the first second; how many bytes of messages came in each second.
pub(crate) fn read(url: &str, span: Duration) -> Outcome<f64> {
    let mut socket = connect(url)?;
    let (begun, mut bytes, mut since) = (Instant::now(), 0, None);
    while begun.elapsed() < span {
        match socket.read()? {
            Message::Text(text) => {
                let told: Value = serde_json::from_str(&text)?;
                let channels = told["channels"].as_array().into_iter().flatten();
                let word = |channel: &Value| channel["topic"].as_str()?.rsplit('/').next().map(str::to_owned);
                let is_seldom =
                    |word: String| ["lines", "cloud", "tilt", "tf_static"].contains(&word.as_str());
                let wanted = channels.filter(|channel| !word(channel).is_some_and(is_seldom));
                let wanted: Vec<Value> = wanted
                    .map(|channel| json!({ "id": channel["id"], "channelId": channel["id"] }))
                    .collect();
                if !wanted.is_empty() {
                    let wish = json!({ "op": "subscribe", "subscriptions": wanted });
                    socket.send(Message::text(wish.to_string()))?;
                }
            }
            Message::Binary(frame) if begun.elapsed() > SETTLING => {
                since.get_or_insert_with(Instant::now);
                bytes += frame.len();
            }
            _ => {}
        }
    }
    Ok(bytes as f64 / since.ok_or("nothing came")?.elapsed().as_secs_f64())
}

/// So many of them, each in a thread of its own, until `span` is over.
pub(crate) fn crowd(url: &str, count: usize, span: Duration) -> Vec<thread::JoinHandle<()>> {
    let one = |_| {
        let url = url.to_owned();
        thread::spawn(move || {
            if let Err(error) = read(&url, span) {
                eprintln!("a viewer: {error}");
            }
        })
    };
    (0..count).map(one).collect()
}

fn connect(url: &str) -> Outcome<WebSocket<TcpStream>> {
    let host = url.trim_start_matches("http://").trim_end_matches('/');
    let mut request = format!("ws://{host}/").into_client_request()?;
    request.headers_mut().insert("Sec-WebSocket-Protocol", "foxglove.sdk.v1".parse()?);
    let (socket, _) = tungstenite::client(request, TcpStream::connect(host)?)?;
    Ok(socket)
}

const SETTLING: Duration = Duration::from_secs(1);
