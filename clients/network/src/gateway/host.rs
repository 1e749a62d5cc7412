//! Host that gets copies of all datagrams, and the current address of its name. The name is resolved again in the
//! background, because resolving a name may take half a minute.

use std::io;
use std::net::{IpAddr, SocketAddr, ToSocketAddrs};
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use scanhub_schema::{Failure, Kind};
use scanhub_verbs::discovery::BackgroundTask;

/// A host and port.
#[derive(Debug)]
pub(super) struct Host {
    /// `HOST:PORT`, as the user wrote it.
    text: String,
    address: SocketAddr,
    /// Time at which the name was resolved last; `None` for a literal address.
    resolved_at: Option<Instant>,
    task: Option<BackgroundTask<Option<SocketAddr>>>,
    resolve: Resolver,
}

/// Function that resolves a name to addresses.
pub(super) type Resolver = fn(&str) -> io::Result<Vec<SocketAddr>>;

/// Interval at which a name is resolved again, because machines may get another address.
const RESOLVE_INTERVAL: Duration = Duration::from_secs(60);
/// Interval at which a name is resolved again while datagrams to it fail.
const RESOLVE_INTERVAL_FAILING: Duration = Duration::from_secs(5);

impl Host {
    /// Resolves the host and port in `text`. The `more_ports` ports above that port must exist, too.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`] if `text` does not name a host and a possible port, names a group, or is a
    /// link-local address without an interface. Returns [`Kind::Interrupted`] if `stop` is set before the host is
    /// resolved.
    pub(super) fn parse(text: &str, more_ports: u16, stop: &AtomicBool) -> Result<Host, Failure> {
        Host::resolve_with(resolve, text, more_ports, stop, Instant::now())
    }

    /// Does the same as [`parse`](Host::parse), but resolves the name with `resolve`, and takes the time `now`.
    pub(super) fn resolve_with(
        resolve: Resolver,
        text: &str,
        more_ports: u16,
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
        let ports = 1..=u16::MAX - more_ports;
        if found.iter().any(|address| !ports.contains(&address.port())) {
            let hint = format!("a port from {} to {}", ports.start(), ports.end());
            return Err(refuse(format!("cannot send to {text}: the port is not possible"), &hint));
        }
        let address = choose(&found, None).ok_or_else(|| {
            let hint = "the groups get everything anyway; name single hosts only";
            refuse(format!("cannot send to {text}: it is not a host"), hint)
        })?;
        if matches!(address, SocketAddr::V6(six) if six.ip().is_unicast_link_local() && six.scope_id() == 0) {
            let hint = "add the interface to the address, as in [fe80::7%eth0]:22200";
            return Err(refuse(
                format!("cannot send to {text}: a link-local address needs an interface"),
                hint,
            ));
        }
        let is_name = text.parse::<SocketAddr>().is_err();
        let resolved_at = is_name.then_some(now);
        Ok(Host { text: text.to_owned(), address, resolved_at, task: None, resolve })
    }

    /// Returns the current address.
    pub(super) fn address(&self) -> SocketAddr {
        self.address
    }

    /// Continues with `address`.
    pub(super) fn set_address(&mut self, address: SocketAddr) {
        self.address = address;
    }

    /// Returns the name's new address if a query has just ended with another address. Starts a query once a minute, or
    /// every 5 s if `is_failing`, which means that datagrams to the host fail.
    pub(super) fn new_address(&mut self, is_failing: bool, now: Instant) -> Option<SocketAddr> {
        if let Some(task) = &self.task {
            let found = task.result()?;
            self.task = None;
            return found.filter(|address| *address != self.address);
        }
        let interval = if is_failing { RESOLVE_INTERVAL_FAILING } else { RESOLVE_INTERVAL };
        if self.resolved_at.is_some_and(|at| now - at >= interval) {
            let (resolve, text, address) = (self.resolve, self.text.clone(), self.address);
            let query = move || resolve(&text).ok().and_then(|found| choose(&found, Some(address)));
            self.task = BackgroundTask::begin(query);
            self.resolved_at = Some(now);
        }
        None
    }
}

/// Resolves `HOST:PORT` with the system's resolver. The resolver accepts an IPv6 address with an interface, but not in
/// brackets, so this function removes them.
fn resolve(text: &str) -> io::Result<Vec<SocketAddr>> {
    let bracketed = text.strip_prefix('[').and_then(|text| text.rsplit_once("]:"));
    let scoped = bracketed.filter(|(host, _)| host.contains('%'));
    let plain = scoped.map(|(host, port)| format!("{host}:{port}"));
    Ok(plain.as_deref().unwrap_or(text).to_socket_addrs()?.collect())
}

/// Returns the address to send to: the current one if it is in `found`, otherwise the first IPv4 address, because all
/// listeners receive over IPv4, otherwise the first IPv6 address.
fn choose(found: &[SocketAddr], current: Option<SocketAddr>) -> Option<SocketAddr> {
    let hosts: Vec<_> =
        found.iter().copied().map(canonical).filter(|address| is_host(address.ip())).collect();
    let first = hosts.iter().find(|address| address.is_ipv4()).or(hosts.first()).copied();
    current.filter(|current| hosts.contains(current)).or(first)
}

/// Converts an IPv4 address that is written as an IPv6 address, such as `::ffff:10.0.0.7`, to IPv4.
fn canonical(address: SocketAddr) -> SocketAddr {
    match address.ip().to_canonical() {
        IpAddr::V4(ip) => SocketAddr::from((ip, address.port())),
        IpAddr::V6(_) => address,
    }
}

/// Returns whether `ip` may be the address of a single host, rather than of a group or of all hosts.
fn is_host(ip: IpAddr) -> bool {
    let is_broadcast = matches!(ip, IpAddr::V4(ip) if ip.is_broadcast());
    !(ip.is_multicast() || ip.is_unspecified() || is_broadcast)
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU32, Ordering};

    use super::*;

    static NO_STOP: AtomicBool = AtomicBool::new(false);

    #[test]
    fn stop_ends_the_wait_for_a_name() {
        fn never(_: &str) -> io::Result<Vec<SocketAddr>> {
            loop {
                std::thread::park();
            }
        }
        let refused =
            Host::resolve_with(never, "robot:7", 0, &AtomicBool::new(true), Instant::now()).unwrap_err();
        assert!(refused.kind == Kind::Interrupted && refused.message.contains("robot:7"), "{refused}");
    }

    #[test]
    fn link_local_address_needs_an_interface() {
        let of = |text: &str| Host::parse(text, 0, &NO_STOP).map(|host| host.address().to_string());
        let refused = of("[fe80::1]:7").unwrap_err();
        assert!(refused.kind == Kind::Configuration && refused.hint.contains("%eth0"), "{refused}");
        assert_eq!(of("[fe80::1%3]:7"), Ok("[fe80::1%3]:7".into()));
        let lo = crate::interface::by_name("lo").unwrap().index;
        assert_eq!(of("[fe80::1%lo]:7"), Ok(format!("[fe80::1%{lo}]:7")));
        assert!(of("[fe80::1%no-such]:7").is_err() && of("[fe80::1%lo]:").is_err());
    }

    #[test]
    fn refuses_invalid_hosts() {
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
            let refused = Host::parse(bad, 0, &NO_STOP).map(drop).unwrap_err();
            assert_eq!(refused.kind, Kind::Configuration, "{refused}");
            assert!(refused.message.contains(bad) && !refused.hint.is_empty(), "{refused}");
        }
        assert!(Host::parse("127.0.0.1:0", 0, &NO_STOP).is_err());
        let last = |more| Host::parse("127.0.0.1:65535", more, &NO_STOP);
        assert!(last(255).is_err() && last(0).is_ok());
    }

    #[test]
    fn chooses_ipv4_unless_the_address_is_current() {
        let of = |text: &str| Host::parse(text, 0, &NO_STOP).unwrap().address().to_string();
        assert_eq!((of("127.0.0.1:7"), of("[::1]:7")), ("127.0.0.1:7".into(), "[::1]:7".into()));
        assert_eq!(of("[::ffff:10.0.0.7]:7"), "10.0.0.7:7");
        let (four, six) = (SocketAddr::from(([10, 0, 0, 7], 7)), "[fe80::1]:7".parse().unwrap());
        assert_eq!((choose(&[six, four], None), choose(&[six], None)), (Some(four), Some(six)));
        assert_eq!(choose(&[four, six], Some(six)), Some(six), "it is the current one");
        assert_eq!(choose(&[], Some(six)), None);
    }

    #[test]
    fn resolves_host_name_again_after_an_interval() {
        static QUERIES: AtomicU32 = AtomicU32::new(0);
        // Queries 0 and 1 return one address, and queries 2 and 3 the next one.
        fn resolve(_: &str) -> io::Result<Vec<SocketAddr>> {
            let number = QUERIES.fetch_add(1, Ordering::SeqCst);
            Ok(vec![SocketAddr::from(([10, 0, 0, number as u8 / 2], 7))])
        }
        fn wait_for_address(host: &mut Host, now: Instant) -> Option<SocketAddr> {
            let deadline = Instant::now() + Duration::from_secs(30);
            while host.task.is_some() {
                if let Some(address) = host.new_address(false, now) {
                    return Some(address);
                }
                assert!(Instant::now() < deadline);
                std::thread::yield_now();
            }
            None
        }
        let begin = Instant::now();
        let at = |s: u64| begin + Duration::from_secs(s);
        let mut host = Host::resolve_with(resolve, "robot:7", 0, &NO_STOP, begin).unwrap();
        assert!((0..60).all(|s| host.new_address(false, at(s)).is_none()));
        assert_eq!(QUERIES.load(Ordering::SeqCst), 1);
        assert_eq!(
            (host.new_address(false, at(60)), wait_for_address(&mut host, at(61))),
            (None, None),
            "the same"
        );
        assert!(host.new_address(true, at(64)).is_none() && host.task.is_none(), "not so soon");
        assert_eq!(host.new_address(true, at(65)), None);
        let moved = wait_for_address(&mut host, at(66)).unwrap();
        assert_eq!((moved.to_string().as_str(), QUERIES.load(Ordering::SeqCst)), ("10.0.0.1:7", 3));
        // A literal address is not resolved again.
        let mut fixed = Host::resolve_with(resolve, "10.0.0.9:7", 0, &NO_STOP, begin).unwrap();
        assert!(fixed.new_address(true, at(1000)).is_none() && fixed.task.is_none());
    }
}
