//! Who may come in: the host that a browser means, the page that it asks from, and the word that he knows. A page of somebody
//! else's that makes a browser ask here, under whatever name, gets nothing. Refuses to know sockets.

use std::net::IpAddr;

/// What the door is opened for.
#[derive(Clone, Debug, Default)]
pub struct Door {
    /// The word that page and socket take, if they do.
    pub token: Option<String>,
    /// Pages from elsewhere whose viewers may come, as `https://app.example.org`.
    pub origins: Vec<String>,
    /// Names of this machine, beside `localhost` and addresses.
    pub names: Vec<String>,
}

/// Who asks.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Caller<'a> {
    /// The header `Host`.
    pub(crate) host: Option<&'a str>,
    /// The header `Origin`, which programs do not send.
    pub(crate) origin: Option<&'a str>,
    /// The header `Authorization`.
    pub(crate) authorization: Option<&'a str>,
    /// What follows `?` in the path.
    pub(crate) query: &'a str,
}

/// Why somebody may not come in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Refusal {
    /// His browser was led here by a name that is not this machine's.
    Host,
    /// A page of somebody else asks.
    Origin,
    /// The word is missing, or another.
    Token,
}

impl Refusal {
    /// In words, with the remedy.
    pub(crate) fn words(self) -> &'static str {
        match self {
            Refusal::Host => "not a name of this machine: use its address",
            Refusal::Origin => "not from this page: scanhub web --allow-origin URL",
            Refusal::Token => "the token is missing or wrong: open the address that scanhub web printed",
        }
    }
}

impl Door {
    pub(crate) fn check(&self, caller: &Caller<'_>) -> Result<(), Refusal> {
        let host = caller.host.filter(|host| self.is_here(host)).ok_or(Refusal::Host)?;
        let is_own = |origin: &str| {
            origin.strip_prefix("http://").is_some_and(|authority| authority.eq_ignore_ascii_case(host))
        };
        let is_named = |origin: &str| self.origins.iter().any(|named| named.trim_end_matches('/') == origin);
        if caller.origin.is_some_and(|origin| !is_own(origin) && !is_named(origin)) {
            return Err(Refusal::Origin);
        }
        let Some(token) = &self.token else { return Ok(()) };
        let said = caller.query.split('&').filter_map(|pair| pair.strip_prefix("token="));
        let said = said.chain(caller.authorization.and_then(|header| header.strip_prefix("Bearer ")));
        // Every candidate is compared to its end: the time says nothing about the word.
        let is_known = said.map(|word| same(word.trim(), token)).fold(false, |any, one| any | one);
        if is_known { Ok(()) } else { Err(Refusal::Token) }
    }

    /// An address cannot be made to point elsewhere; of names those of this machine alone are believed.
    fn is_here(&self, host: &str) -> bool {
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

/// In a time that depends on lengths alone.
fn same(said: &str, token: &str) -> bool {
    let differing = said.bytes().zip(token.bytes()).fold(0, |all, (a, b)| all | (a ^ b));
    said.len() == token.len() && differing == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(host: &str) -> Caller<'_> {
        Caller { host: Some(host), ..Caller::default() }
    }

    #[test]
    fn names_that_are_not_this_machines_are_refused() {
        let door = Door { names: vec!["robot".into(), "cart.local".into()], ..Door::default() };
        for host in [
            "cart.local",
            "127.0.0.1:8080",
            "localhost:9",
            "[::1]:8080",
            "10.0.0.7",
            "robot:80",
            "Robot.local:8080",
        ] {
            assert_eq!(door.check(&at(host)), Ok(()), "{host}");
        }
        for host in
            ["evil.example:8080", "localhost.evil.example", "robot.evil.example", "", ".local", "ö.local"]
        {
            assert_eq!(door.check(&at(host)), Err(Refusal::Host), "{host}");
        }
        assert_eq!(door.check(&Caller::default()), Err(Refusal::Host));
    }

    #[test]
    fn pages_from_elsewhere_come_by_name_only() {
        let door = Door { origins: vec!["https://viewer.example/".into()], ..Door::default() };
        let from = |origin| door.check(&Caller { origin: Some(origin), ..at("127.0.0.1:8080") });
        assert_eq!((from("http://127.0.0.1:8080"), from("https://viewer.example")), (Ok(()), Ok(())));
        for origin in
            ["http://127.0.0.1:8081", "https://127.0.0.1:8080", "null", "https://viewer.example.org", ""]
        {
            assert_eq!(from(origin), Err(Refusal::Origin), "{origin}");
        }
    }

    #[test]
    fn the_word_comes_in_the_address_or_in_a_header() {
        let door = Door { token: Some("carrot".into()), ..Door::default() };
        let said = |query, authorization| door.check(&Caller { query, authorization, ..at("10.0.0.7:80") });
        assert_eq!(said("token=carrot", None), Ok(()));
        assert_eq!(said("a=b&token=carrot", None), Ok(()));
        assert_eq!(said("", Some("Bearer carrot")), Ok(()));
        for (query, header) in
            [("", None), ("token=carro", None), ("token=", None), ("token", Some("carrot"))]
        {
            assert_eq!(said(query, header), Err(Refusal::Token), "{query}");
        }
    }
}
