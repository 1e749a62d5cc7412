//! A host that gets copies, by the name that the user wrote: which address that has now. Asked again beside the sending,
//! as an answer may take half a minute. Refuses to know sockets.

use std::io;
use std::net::{IpAddr, SocketAddr, ToSocketAddrs};
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use scanhub_schema::{Failure, Kind};

use scanhub_verbs::discovery::BackgroundTask;

/// A host and port.
#[derive(Debug)]
pub(super) struct Host {
    text: String,
    address: SocketAddr,
    /// When its name was last asked for; never, if it is an address.
    asked_at: Option<Instant>,
    task: Option<BackgroundTask<Option<SocketAddr>>>,
    resolve: Resolve,
}

/// What knows the addresses of a name.
pub(super) type Resolve = fn(&str) -> io::Result<Vec<SocketAddr>>;

/// Between two questions for a name: machines are given other addresses.
const EVERY: Duration = Duration::from_secs(60);
/// The same while nothing gets there.
const EVERY_IN_TROUBLE: Duration = Duration::from_secs(5);

impl Host {
    /// The host and port in `text`, and up to `more` ports above it. Waits for the answer.
    ///
    /// [`Kind::Configuration`] if `text` names none, or a group; [`Kind::Interrupted`] if `stop` is set before the answer.
    pub(super) fn parse(text: &str, more: u16, stop: &AtomicBool) -> Result<Host, Failure> {
        Host::by(resolve, text, more, stop, Instant::now())
    }

    /// The same, as `resolve` knows it.
    pub(super) fn by(
        resolve: Resolve,
        text: &str,
        more: u16,
        stop: &AtomicBool,
        now: Instant,
    ) -> Result<Host, Failure> {
        let refuse = |what: String, hint: &str| Failure::new(Kind::Configuration, what, hint);
        let name = text.to_owned();
        let found = match BackgroundTask::begin(move || resolve(&name)) {
            Some(task) => task.wait(stop).ok_or_else(|| {
                let what = format!("interrupted before {text} was resolved");
                Failure::new(Kind::Interrupted, what, "")
            })?,
            None => resolve(text),
        };
        let found = found.map_err(|error| {
            let hint = "write HOST:PORT with a name that is known here, or an address, as in 10.0.0.7:22200";
            refuse(format!("cannot send to {text}: {error}"), hint)
        })?;
        let ports = 1..=u16::MAX - more;
        if found.iter().any(|address| !ports.contains(&address.port())) {
            let hint = format!("a port from {} to {}", ports.start(), ports.end());
            return Err(refuse(format!("cannot send to {text}: the port is not possible"), &hint));
        }
        let address = choose(&found, None).ok_or_else(|| {
            let hint = "the groups get everything anyway; name single hosts only";
            refuse(format!("cannot send to {text}: it is no host"), hint)
        })?;
        if matches!(address, SocketAddr::V6(six) if six.ip().is_unicast_link_local() && six.scope_id() == 0) {
            let hint = "add the interface to the address, as in [fe80::7%eth0]:22200";
            return Err(refuse(
                format!("cannot send to {text}: a link-local address needs an interface"),
                hint,
            ));
        }
        let is_name = text.parse::<SocketAddr>().is_err();
        let asked_at = is_name.then_some(now);
        Ok(Host { text: text.to_owned(), address, asked_at, task: None, resolve })
    }

    /// Where it is.
    pub(super) fn address(&self) -> SocketAddr {
        self.address
    }

    /// Goes on at `address`.
    pub(super) fn move_to(&mut self, address: SocketAddr) {
        self.address = address;
    }

    /// Another address that it has now, if that was answered since the last call. Its name is asked for once a minute, and
    /// more often if it is `in_trouble`; one question at a time.
    pub(super) fn look(&mut self, in_trouble: bool, now: Instant) -> Option<SocketAddr> {
        if let Some(task) = &self.task {
            let found = task.result()?;
            self.task = None;
            return found.filter(|address| *address != self.address);
        }
        let every = if in_trouble { EVERY_IN_TROUBLE } else { EVERY };
        if self.asked_at.is_some_and(|at| now - at >= every) {
            let (resolve, text, address) = (self.resolve, self.text.clone(), self.address);
            let question = move || resolve(&text).ok().and_then(|found| choose(&found, Some(address)));
            self.task = BackgroundTask::begin(question);
            self.asked_at = Some(now);
        }
        None
    }
}

/// What the system knows of `HOST:PORT`. It knows an address with the name of an interface, but not within brackets.
fn resolve(text: &str) -> io::Result<Vec<SocketAddr>> {
    let bracketed = text.strip_prefix('[').and_then(|text| text.rsplit_once("]:"));
    let scoped = bracketed.filter(|(host, _)| host.contains('%'));
    let plain = scoped.map(|(host, port)| format!("{host}:{port}"));
    Ok(plain.as_deref().unwrap_or(text).to_socket_addrs()?.collect())
}

/// The address that datagrams go to: the present one as long as it is among them, else the first one of IPv4, which all
/// listeners hear, else the first one.
fn choose(found: &[SocketAddr], present: Option<SocketAddr>) -> Option<SocketAddr> {
    let hosts: Vec<_> = found.iter().copied().map(plain).filter(|address| is_host(address.ip())).collect();
    let first = hosts.iter().find(|address| address.is_ipv4()).or(hosts.first()).copied();
    present.filter(|present| hosts.contains(present)).or(first)
}

/// An IPv4 address that is written as one of IPv6 is one of IPv4.
fn plain(address: SocketAddr) -> SocketAddr {
    match address.ip().to_canonical() {
        IpAddr::V4(ip) => SocketAddr::from((ip, address.port())),
        IpAddr::V6(_) => address,
    }
}

fn is_host(ip: IpAddr) -> bool {
    let is_broadcast = matches!(ip, IpAddr::V4(ip) if ip.is_broadcast());
    !(ip.is_multicast() || ip.is_unspecified() || is_broadcast)
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU32, Ordering};

    use super::*;

    static GO_ON: AtomicBool = AtomicBool::new(false);

    #[test]
    fn who_does_not_want_to_wait_for_a_name_is_let_go() {
        fn never(_: &str) -> io::Result<Vec<SocketAddr>> {
            loop {
                std::thread::park();
            }
        }
        let refused = Host::by(never, "robot:7", 0, &AtomicBool::new(true), Instant::now()).unwrap_err();
        assert!(refused.kind == Kind::Interrupted && refused.message.contains("robot:7"), "{refused}");
    }

    #[test]
    fn an_address_of_one_link_has_its_interface() {
        let of = |text: &str| Host::parse(text, 0, &GO_ON).map(|host| host.address().to_string());
        let refused = of("[fe80::1]:7").unwrap_err();
        assert!(refused.kind == Kind::Configuration && refused.hint.contains("%eth0"), "{refused}");
        assert_eq!(of("[fe80::1%3]:7"), Ok("[fe80::1%3]:7".into()));
        let lo = crate::interface::named("lo").unwrap().index;
        assert_eq!(of("[fe80::1%lo]:7"), Ok(format!("[fe80::1%{lo}]:7")));
        assert!(of("[fe80::1%no-such]:7").is_err() && of("[fe80::1%lo]:").is_err());
    }

    #[test]
    fn hosts_that_are_none() {
        for bad in [
            "",
            "nowhere",
            "10.0.0.1",
            "10.0.0.1:99999",
            "239.255.76.80:22200",
            "0.0.0.0:1",
            "255.255.255.255:1",
            "[::]:22200",
            "[ff02::1]:22200",
            "[::ffff:239.255.76.80]:22200",
            "::1:22200:",
        ] {
            let refused = Host::parse(bad, 0, &GO_ON).map(drop).unwrap_err();
            assert_eq!(refused.kind, Kind::Configuration, "{refused}");
            assert!(refused.message.contains(bad) && !refused.hint.is_empty(), "{refused}");
        }
        assert!(Host::parse("127.0.0.1:0", 0, &GO_ON).is_err());
        let last = |more| Host::parse("127.0.0.1:65535", more, &GO_ON);
        assert!(last(255).is_err() && last(0).is_ok());
    }

    #[test]
    fn addresses_of_both_kinds() {
        let of = |text: &str| Host::parse(text, 0, &GO_ON).unwrap().address().to_string();
        assert_eq!((of("127.0.0.1:7"), of("[::1]:7")), ("127.0.0.1:7".into(), "[::1]:7".into()));
        assert_eq!(of("[::ffff:10.0.0.7]:7"), "10.0.0.7:7");
        let (four, six) = (SocketAddr::from(([10, 0, 0, 7], 7)), "[fe80::1]:7".parse().unwrap());
        assert_eq!((choose(&[six, four], None), choose(&[six], None)), (Some(four), Some(six)));
        assert_eq!(choose(&[four, six], Some(six)), Some(six), "as long as it is there");
        assert_eq!(choose(&[], Some(six)), None);
    }

    #[test]
    fn a_name_is_asked_for_again() {
        static ASKED: AtomicU32 = AtomicU32::new(0);
        // Every second answer is another one.
        fn resolve(_: &str) -> io::Result<Vec<SocketAddr>> {
            let number = ASKED.fetch_add(1, Ordering::SeqCst);
            Ok(vec![SocketAddr::from(([10, 0, 0, number as u8 / 2], 7))])
        }
        fn answer(host: &mut Host, now: Instant) -> Option<SocketAddr> {
            let give_up_at = Instant::now() + Duration::from_secs(30);
            while host.task.is_some() {
                if let Some(address) = host.look(false, now) {
                    return Some(address);
                }
                assert!(Instant::now() < give_up_at);
                std::thread::yield_now();
            }
            None
        }
        let begin = Instant::now();
        let at = |s: u64| begin + Duration::from_secs(s);
        let mut host = Host::by(resolve, "robot:7", 0, &GO_ON, begin).unwrap();
        assert!((0..60).all(|s| host.look(false, at(s)).is_none()));
        assert_eq!(ASKED.load(Ordering::SeqCst), 1);
        assert_eq!((host.look(false, at(60)), answer(&mut host, at(61))), (None, None), "the same");
        assert!(host.look(true, at(64)).is_none() && host.task.is_none(), "not so soon");
        assert_eq!(host.look(true, at(65)), None);
        let moved = answer(&mut host, at(66)).unwrap();
        assert_eq!((moved.to_string().as_str(), ASKED.load(Ordering::SeqCst)), ("10.0.0.1:7", 3));
        // An address is no name.
        let mut fixed = Host::by(resolve, "10.0.0.9:7", 0, &GO_ON, begin).unwrap();
        assert!(fixed.look(true, at(1000)).is_none() && fixed.task.is_none());
    }
}
