//! The head of a request, and the bytes of an answer: as much of HTTP as one page and one socket take. Refuses to know
//! sockets and who may ask.

use crate::server::door::Caller;

/// The longest head of a request.
pub(crate) const LONGEST: usize = 8192;

/// What was asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Request {
    pub(crate) method: String,
    pub(crate) path: String,
    query: String,
    host: Option<String>,
    origin: Option<String>,
    authorization: Option<String>,
    /// The key of a WebSocket's handshake, if that is one.
    pub(crate) key: Option<String>,
    /// The subprotocols that it offers.
    pub(crate) protocols: String,
}

/// A head that is none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Malformed;

impl Request {
    /// The request at the beginning of `bytes` and the length of its head; nothing as long as that is not whole.
    pub(crate) fn parse(bytes: &[u8]) -> Result<Option<(Request, usize)>, Malformed> {
        let mut headers = [httparse::EMPTY_HEADER; 64];
        let mut head = httparse::Request::new(&mut headers);
        let length = match head.parse(bytes).map_err(|_| Malformed)? {
            httparse::Status::Complete(length) => length,
            httparse::Status::Partial if bytes.len() >= LONGEST => return Err(Malformed),
            httparse::Status::Partial => return Ok(None),
        };
        let target = head.path.unwrap_or_default();
        let (path, query) = target.split_once('?').unwrap_or((target, ""));
        let all = |name: &str| {
            let named = head.headers.iter().filter(|header| header.name.eq_ignore_ascii_case(name));
            named.map(|header| std::str::from_utf8(header.value).unwrap_or("?").trim().to_owned()).collect()
        };
        // Two of them are two opinions: whoever stands between may have believed the other one.
        let one = |name: &str| -> Result<Option<String>, Malformed> {
            let mut values: Vec<String> = all(name);
            if values.len() > 1 { Err(Malformed) } else { Ok(values.pop()) }
        };
        let says = |name: &str, word: &str| {
            all(name)
                .iter()
                .flat_map(|value| value.split(','))
                .any(|said| said.trim().eq_ignore_ascii_case(word))
        };
        let is_upgrade = says("upgrade", "websocket") && says("connection", "upgrade");
        let is_current = says("sec-websocket-version", "13");
        let key = one("sec-websocket-key")?.filter(|_| is_upgrade && is_current);
        let request = Request {
            method: head.method.unwrap_or_default().to_owned(),
            path: path.to_owned(),
            query: query.to_owned(),
            host: one("host")?,
            origin: one("origin")?,
            authorization: one("authorization")?,
            key,
            protocols: all("sec-websocket-protocol").join(","),
        };
        Ok(Some((request, length)))
    }

    pub(crate) fn caller(&self) -> Caller<'_> {
        Caller {
            host: self.host.as_deref(),
            origin: self.origin.as_deref(),
            authorization: self.authorization.as_deref(),
            query: &self.query,
        }
    }

    /// The subprotocol is among those that it offers.
    pub(crate) fn offers(&self, protocol: &str) -> bool {
        self.protocols.split(',').any(|offered| offered.trim() == protocol)
    }
}

/// An answer that ends the connection. No other page may show it, keep it, or guess what it is.
pub(crate) fn answer(status: &str, kind: &str, policy: &str, body: &[u8]) -> Vec<u8> {
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}; charset=utf-8\r\nContent-Length: {}\r\nCache-Control: no-store\r\n\
         X-Content-Type-Options: nosniff\r\nX-Frame-Options: DENY\r\nReferrer-Policy: no-referrer\r\n\
         Cross-Origin-Opener-Policy: same-origin\r\nCross-Origin-Resource-Policy: same-origin\r\n\
         Content-Security-Policy: {policy}\r\nConnection: close\r\n\r\n",
        body.len()
    );
    [head.as_bytes(), body].concat()
}

/// An answer in words.
pub(crate) fn words(status: &str, text: &str) -> Vec<u8> {
    answer(status, "text/plain", "default-src 'none'", format!("scanhub: {text}\n").as_bytes())
}

/// The answer to a WebSocket's handshake.
pub(crate) fn upgrade(key: &str, protocol: &str) -> Vec<u8> {
    let accept = tungstenite::handshake::derive_accept_key(key.as_bytes());
    let head = format!(
        "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
         Sec-WebSocket-Accept: {accept}\r\nSec-WebSocket-Protocol: {protocol}\r\n\r\n"
    );
    head.into_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    const UPGRADE: &str = "GET /?token=a HTTP/1.1\r\nHost: robot:8080\r\nUpgrade: websocket\r\n\
        Connection: keep-alive, Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\
        Sec-WebSocket-Protocol: a, foxglove.sdk.v1\r\nOrigin: http://robot:8080\r\n\r\n";

    #[test]
    fn a_head_is_read_when_it_is_whole() {
        for end in 0..UPGRADE.len() {
            assert_eq!(Request::parse(&UPGRADE.as_bytes()[..end]), Ok(None), "{end}");
        }
        let (request, length) = Request::parse(format!("{UPGRADE}more").as_bytes()).unwrap().unwrap();
        assert_eq!((length, &request.path[..], request.caller().query), (UPGRADE.len(), "/", "token=a"));
        assert_eq!((request.caller().host, request.key.is_some()), (Some("robot:8080"), true));
        assert!(request.offers("foxglove.sdk.v1") && !request.offers("foxglove.sdk"));
        let key = request.key.unwrap();
        let said = String::from_utf8(upgrade(&key, "foxglove.sdk.v1")).unwrap();
        // The example of RFC 6455, 1.3.
        assert!(said.contains("Sec-WebSocket-Accept: s3pPLMBiTxaQ9kYGzzhZRbK+xOo=\r\n"), "{said}");
    }

    #[test]
    fn two_hosts_and_endless_heads_are_refused() {
        assert_eq!(Request::parse(b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n"), Err(Malformed));
        assert_eq!(Request::parse(b"\x16\x03\x01\x02\x00"), Err(Malformed));
        let endless = format!("GET /{}", "a".repeat(LONGEST));
        assert_eq!(Request::parse(endless.as_bytes()), Err(Malformed));
        let plain = Request::parse(b"GET / HTTP/1.1\r\nSec-WebSocket-Key: x\r\n\r\n").unwrap().unwrap().0;
        assert_eq!(plain.key, None, "no handshake without its other headers");
    }
}
