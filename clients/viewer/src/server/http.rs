//! HTTP for one page and one WebSocket: heads of requests, access control, and responses.

use std::net::IpAddr;

/// Maximum length of the head of a request, in bytes.
pub(crate) const MAX_HEAD_LEN: usize = 8192;

/// Head of a request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Request {
    pub(crate) method: String,
    pub(crate) path: String,
    /// Text after `?` in the path.
    query: String,
    pub(crate) host: Option<String>,
    /// Header `Origin`. Only browsers send this header.
    origin: Option<String>,
    authorization: Option<String>,
    /// Key of the WebSocket handshake; `None` if the request is not a handshake.
    pub(crate) key: Option<String>,
    /// Subprotocols that the client offers.
    protocols: String,
}

/// Error: the bytes are not a valid head.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct MalformedRequest;

impl Request {
    /// Parses the head at the start of `bytes`. Returns the request and the length of the head, or `None` while the
    /// head is incomplete.
    pub(crate) fn parse(bytes: &[u8]) -> Result<Option<(Request, usize)>, MalformedRequest> {
        let mut headers = [httparse::EMPTY_HEADER; 64];
        let mut head = httparse::Request::new(&mut headers);
        let length = match head.parse(bytes).map_err(|_| MalformedRequest)? {
            httparse::Status::Complete(length) => length,
            httparse::Status::Partial if bytes.len() >= MAX_HEAD_LEN => return Err(MalformedRequest),
            httparse::Status::Partial => return Ok(None),
        };
        let target = head.path.unwrap_or_default();
        let (path, query) = target.split_once('?').unwrap_or((target, ""));
        let all = |name: &str| {
            let named = head.headers.iter().filter(|header| header.name.eq_ignore_ascii_case(name));
            named.map(|header| std::str::from_utf8(header.value).unwrap_or("?").trim().to_owned()).collect()
        };
        // Reject a repeated header, because a proxy may have checked the other value.
        let one = |name: &str| -> Result<Option<String>, MalformedRequest> {
            let mut values: Vec<String> = all(name);
            if values.len() > 1 { Err(MalformedRequest) } else { Ok(values.pop()) }
        };
        let has = |name: &str, expected: &str| {
            let values: Vec<String> = all(name);
            let mut words = values.iter().flat_map(|value| value.split(','));
            words.any(|word| word.trim().eq_ignore_ascii_case(expected))
        };
        let is_upgrade = has("upgrade", "websocket") && has("connection", "upgrade");
        let is_current = has("sec-websocket-version", "13");
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

    /// Returns whether the client offers this subprotocol.
    pub(crate) fn offers(&self, protocol: &str) -> bool {
        self.protocols.split(',').any(|offered| offered.trim() == protocol)
    }
}

/// Hosts, origins and token that a request must have. A page of another site cannot use a visitor's browser to connect,
/// not even through DNS rebinding.
#[derive(Clone, Debug, Default)]
pub struct AccessPolicy {
    /// Token that the URL or a header must have; `None` if no token is required.
    pub token: Option<String>,
    /// Origins of other pages that may connect, such as `https://app.example.org`.
    pub origins: Vec<String>,
    /// Names of this machine, in addition to `localhost` and addresses.
    pub names: Vec<String>,
}

/// Reason why a request is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Refusal {
    /// The browser used a host name that does not belong to this machine.
    Host,
    /// The request was made by a page of another site.
    Origin,
    /// The token is missing or wrong.
    Token,
}

impl AccessPolicy {
    /// Checks the headers `Host` and `Origin` and the token of a request.
    pub(crate) fn check(&self, request: &Request) -> Result<(), Refusal> {
        let host = request.host.as_deref().filter(|host| self.is_this_machine(host)).ok_or(Refusal::Host)?;
        let is_own = |origin: &str| {
            origin.strip_prefix("http://").is_some_and(|authority| authority.eq_ignore_ascii_case(host))
        };
        let is_named = |origin: &str| self.origins.iter().any(|named| named.trim_end_matches('/') == origin);
        if request.origin.as_deref().is_some_and(|origin| !is_own(origin) && !is_named(origin)) {
            return Err(Refusal::Origin);
        }
        let Some(token) = &self.token else { return Ok(()) };
        let in_url = request.query.split('&').filter_map(|pair| pair.strip_prefix("token="));
        let in_header = request.authorization.as_deref().and_then(|header| header.strip_prefix("Bearer "));
        // Every candidate is compared completely, so that the response time reveals nothing about the token.
        let is_equal = |candidate: &str| is_equal(candidate.trim(), token);
        let is_known = in_url.chain(in_header).map(is_equal).fold(false, |any, one| any | one);
        if is_known { Ok(()) } else { Err(Refusal::Token) }
    }

    /// Returns whether `host` is this machine. DNS can make a name point to another machine, but not an address.
    /// Therefore every address is accepted, but only names of this machine.
    fn is_this_machine(&self, host: &str) -> bool {
        let name = match host.strip_prefix('[') {
            Some(rest) => rest.split(']').next().unwrap_or_default(),
            None => host.rsplit_once(':').map_or(host, |(name, _)| name),
        };
        if !host.chars().all(|sign| sign.is_ascii_alphanumeric() || ".:-[]".contains(sign)) {
            return false;
        }
        let lower = name.to_ascii_lowercase();
        let bare = lower.strip_suffix(".local").unwrap_or(&lower);
        name.parse::<IpAddr>().is_ok()
            || lower == "localhost"
            || self.names.iter().any(|own| own.eq_ignore_ascii_case(bare) || own.eq_ignore_ascii_case(&lower))
    }
}

/// Compares a candidate with the token. The time of the comparison depends only on the lengths of the two texts.
fn is_equal(candidate: &str, token: &str) -> bool {
    let differing = candidate.bytes().zip(token.bytes()).fold(0, |all, (a, b)| all | (a ^ b));
    candidate.len() == token.len() && differing == 0
}

impl Refusal {
    /// Returns the response for this refusal, with a remedy.
    pub(crate) fn response(self) -> Vec<u8> {
        let (status, message) = match self {
            Refusal::Host => ("403 Forbidden", "not a name of this machine: use its address"),
            Refusal::Origin => ("403 Forbidden", "not from this page: scanhub web --allow-origin URL"),
            Refusal::Token => (
                "401 Unauthorized",
                "the token is missing or wrong: open the address that scanhub web printed",
            ),
        };
        text_response(status, message)
    }
}

/// Returns a response that ends the connection. Other pages cannot embed the response. Browsers neither store the
/// response nor guess its type.
pub(crate) fn response(status: &str, kind: &str, policy: &str, body: &[u8]) -> Vec<u8> {
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}; charset=utf-8\r\nContent-Length: {}\r\nCache-Control: no-store\r\n\
         X-Content-Type-Options: nosniff\r\nX-Frame-Options: DENY\r\nReferrer-Policy: no-referrer\r\n\
         Cross-Origin-Opener-Policy: same-origin\r\nCross-Origin-Resource-Policy: same-origin\r\n\
         Content-Security-Policy: {policy}\r\nConnection: close\r\n\r\n",
        body.len()
    );
    [head.as_bytes(), body].concat()
}

/// Returns a response with a line of text.
pub(crate) fn text_response(status: &str, text: &str) -> Vec<u8> {
    response(status, "text/plain", "default-src 'none'", format!("scanhub: {text}\n").as_bytes())
}

/// Returns the response to a WebSocket handshake.
pub(crate) fn upgrade_response(key: &str, protocol: &str) -> Vec<u8> {
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
    fn parses_a_head_once_it_is_complete() {
        for end in 0..UPGRADE.len() {
            assert_eq!(Request::parse(&UPGRADE.as_bytes()[..end]), Ok(None), "{end}");
        }
        let (request, length) = Request::parse(format!("{UPGRADE}more").as_bytes()).unwrap().unwrap();
        assert_eq!((length, &request.path[..], &request.query[..]), (UPGRADE.len(), "/", "token=a"));
        assert_eq!((request.host.as_deref(), request.key.is_some()), (Some("robot:8080"), true));
        assert!(request.offers("foxglove.sdk.v1") && !request.offers("foxglove.sdk"));
        let key = request.key.unwrap();
        let response = String::from_utf8(upgrade_response(&key, "foxglove.sdk.v1")).unwrap();
        // The example of RFC 6455, 1.3.
        assert!(response.contains("Sec-WebSocket-Accept: s3pPLMBiTxaQ9kYGzzhZRbK+xOo=\r\n"), "{response}");
    }

    #[test]
    fn refuses_two_hosts_and_endless_heads() {
        assert_eq!(Request::parse(b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n"), Err(MalformedRequest));
        assert_eq!(Request::parse(b"\x16\x03\x01\x02\x00"), Err(MalformedRequest));
        let endless = format!("GET /{}", "a".repeat(MAX_HEAD_LEN));
        assert_eq!(Request::parse(endless.as_bytes()), Err(MalformedRequest));
        let plain = Request::parse(b"GET / HTTP/1.1\r\nSec-WebSocket-Key: x\r\n\r\n").unwrap().unwrap().0;
        assert_eq!(plain.key, None, "a handshake has other headers too");
    }

    /// Returns the outcome for a request with this query and these headers.
    fn check(policy: &AccessPolicy, query: &str, headers: &[(&str, &str)]) -> Result<(), Refusal> {
        let headers: String = headers.iter().map(|(name, value)| format!("{name}: {value}\r\n")).collect();
        let head = format!("GET /?{query} HTTP/1.1\r\n{headers}\r\n");
        policy.check(&Request::parse(head.as_bytes()).unwrap().unwrap().0)
    }

    #[test]
    fn refuses_names_of_other_machines() {
        let policy =
            AccessPolicy { names: vec!["robot".into(), "cart.local".into()], ..AccessPolicy::default() };
        for host in [
            "cart.local",
            "127.0.0.1:8080",
            "localhost:9",
            "[::1]:8080",
            "10.0.0.7",
            "robot:80",
            "Robot.local:8080",
        ] {
            assert_eq!(check(&policy, "", &[("Host", host)]), Ok(()), "{host}");
        }
        for host in
            ["evil.example:8080", "localhost.evil.example", "robot.evil.example", "", ".local", "ö.local"]
        {
            assert_eq!(check(&policy, "", &[("Host", host)]), Err(Refusal::Host), "{host}");
        }
        assert_eq!(check(&policy, "", &[]), Err(Refusal::Host));
    }

    #[test]
    fn accepts_other_pages_only_by_their_origin() {
        let origins = vec!["https://viewer.example/".into()];
        let policy = AccessPolicy { origins, ..AccessPolicy::default() };
        let from = |origin| check(&policy, "", &[("Host", "127.0.0.1:8080"), ("Origin", origin)]);
        assert_eq!((from("http://127.0.0.1:8080"), from("https://viewer.example")), (Ok(()), Ok(())));
        for origin in
            ["http://127.0.0.1:8081", "https://127.0.0.1:8080", "null", "https://viewer.example.org", ""]
        {
            assert_eq!(from(origin), Err(Refusal::Origin), "{origin}");
        }
    }

    #[test]
    fn accepts_the_token_in_the_url_or_in_a_header() {
        let policy = AccessPolicy { token: Some("carrot".into()), ..AccessPolicy::default() };
        let check = |query, authorization: Option<&str>| {
            let authorization = authorization.map(|value| ("Authorization", value));
            let headers: Vec<_> = [("Host", "10.0.0.7:80")].into_iter().chain(authorization).collect();
            self::check(&policy, query, &headers)
        };
        assert_eq!(check("token=carrot", None), Ok(()));
        assert_eq!(check("a=b&token=carrot", None), Ok(()));
        assert_eq!(check("", Some("Bearer carrot")), Ok(()));
        for (query, header) in
            [("", None), ("token=carro", None), ("token=", None), ("token", Some("carrot"))]
        {
            assert_eq!(check(query, header), Err(Refusal::Token), "{query}");
        }
    }
}
