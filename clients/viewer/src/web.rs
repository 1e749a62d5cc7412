//! `scanhub web`: what the sensors see, live, for browsers and for viewers of `foxglove.sdk.v1`. Follows the hub as `watch`
//! does, into the same scene, and puts up what that becomes; a thread of its own serves whoever looks at it.

mod feeder;
mod sensor;
mod tilted;
mod told;

use std::fmt;
use std::io::Write;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::thread;

use crate::server::{Board, Door, Playback, Server};
use nix::ifaddrs::getifaddrs;
use nix::net::if_::InterfaceFlags;
use scanhub_schema::{Failure, Kind, Maker, check_followed};
use scanhub_shm::Domain;

use crate::picture;
use feeder::Feeder;
use scanhub_verbs::follow::{Bounds, follow};
use scanhub_verbs::names::as_word;
use scanhub_verbs::output::{Output, quiet};

/// What `web` is asked for.
#[derive(Clone, Debug)]
pub struct WebOptions {
    /// The sensors; none: all of the hub.
    pub sensors: Vec<String>,
    /// Where it listens; if the port is taken, on one of the next.
    pub listen: SocketAddr,
    /// The word that viewers have to know.
    pub token: Option<String>,
    /// Who reaches the address may look, without a word.
    pub open: bool,
    /// Pages from elsewhere whose viewers may come.
    pub origins: Vec<String>,
    /// Names of this machine by which a browser may come, beside its addresses.
    pub names: Vec<String>,
    /// File that the token was read from, if it was.
    pub token_file: Option<PathBuf>,
    /// JSON instead of text.
    pub json: bool,
    /// When it ends by itself.
    pub bounds: Bounds,
    /// Where the domain may be, see [`Domain::candidates`].
    pub places: Vec<Domain>,
}

/// Port that is served if none is named.
pub const WEB_PORT: u16 = 8080;

/// Serves the picture until the bounds are reached or `stop` is set; says on `out` where, and who comes and goes. Viewers
/// have the keys of `player`, if there is one, whose hub no one else has.
///
/// [`Kind::Usage`] if it would listen beyond this machine without a word; [`Kind::Failed`] if it cannot listen; else as
/// [`echo`](crate::echo()).
pub fn web(
    options: &WebOptions,
    player: Option<&dyn Playback>,
    out: &mut dyn Write,
    stop: &AtomicBool,
) -> Result<(), Failure> {
    options.sensors.iter().try_for_each(|sensor| as_word(check_followed(sensor)))?;
    if !options.listen.ip().is_loopback() && options.token.is_none() && !options.open {
        let what = format!("other machines could watch at {}", options.listen);
        let hint = "set a token for viewers (--token WORD), or allow everyone (--open)";
        return Err(Failure::new(Kind::Usage, what, hint));
    }
    if options.token.as_deref().is_some_and(|token| !is_word(token)) {
        let hint = "--token WORD: letters, digits and . _ ~ -, which an address shows as they are";
        return Err(Failure::new(Kind::Usage, "the token is no word", hint));
    }
    let door =
        Door { token: options.token.clone(), origins: options.origins.clone(), names: options.names.clone() };
    let server = Server::bind(options.listen, door)?;
    let board = Board::new()?;
    let (tell, events) = mpsc::channel();
    let mut output = Output::new(out);
    let urls = urls(server.address(), &reachable_addresses(), &options.names, options.token.as_deref());
    if let Err(end) = told::ready(&mut output, &urls, options) {
        return quiet(Err(end));
    }
    let wanted = [&picture::TOPICS[..], Maker::Mount.topics(), Maker::Tilted.topics()].concat();
    let (names, topics) = picture::followed(&options.sensors, &wanted, &options.places);
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        let served = thread::Builder::new()
            .name("web".into())
            // What tells goes with it: who feeds hears that it ended.
            .spawn_scoped(scope, {
                let (server, board, over) = (&server, &board, &over);
                move || server.run(board, player, &tell, over)
            })
            .map_err(|error| Failure::new(Kind::Short, format!("no thread: {error}"), ""))?;
        let closing = Close { over: &over, board: &board };
        let mut feeder = Feeder::new(options, player, &board, events, output);
        let end = follow(&names, &topics, &options.places, &options.bounds, stop, &mut feeder);
        drop(closing);
        match served.join() {
            Ok(Ok(())) => quiet(end),
            Ok(Err(failure)) => Err(failure),
            // It has said why.
            Err(_) => Err(Failure::new(Kind::Failed, "what serves the viewers ended", "start it again")),
        }
    })
}

/// Whether browsers send it as it was written.
fn is_word(token: &str) -> bool {
    !token.is_empty() && token.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"._~-".contains(&byte))
}

/// Returns the URLs of the page. If the server listens on all addresses, they have the name of this machine, if it is known,
/// and then each address in `reachable` of the same version of IP.
fn urls(address: SocketAddr, reachable: &[IpAddr], names: &[String], token: Option<&str>) -> Vec<String> {
    let token = token.map(|token| format!("?token={token}")).unwrap_or_default();
    let of = |host: &dyn fmt::Display| format!("http://{host}/{token}");
    if !address.ip().is_unspecified() {
        return vec![of(&address)];
    }
    let port = address.port();
    let name = names.first().map(|name| of(&format!("{name}:{port}")));
    // A socket for all IPv6 addresses accepts IPv4 too.
    let accepted = reachable.iter().filter(|one| address.is_ipv6() || one.is_ipv4());
    let urls: Vec<String> =
        name.into_iter().chain(accepted.map(|one| of(&SocketAddr::new(*one, port)))).collect();
    if urls.is_empty() { vec![of(&address)] } else { urls }
}

/// Returns the addresses by which other machines can reach this one. Empty if the system does not report them. Link-local
/// IPv6 addresses are left out, because a browser needs the interface too.
fn reachable_addresses() -> Vec<IpAddr> {
    let up = getifaddrs().into_iter().flatten().filter(|entry| entry.flags.contains(InterfaceFlags::IFF_UP));
    let addresses = up.filter_map(|entry| {
        let address = entry.address?;
        let ipv4 = || Some(IpAddr::from(Ipv4Addr::from(address.as_sockaddr_in()?.ip())));
        let ipv6 = || Some(IpAddr::from(address.as_sockaddr_in6()?.ip()));
        ipv4().or_else(ipv6)
    });
    let is_local = |address: &IpAddr| match address {
        IpAddr::V4(address) => address.is_loopback(),
        IpAddr::V6(address) => address.is_loopback() || address.is_unicast_link_local(),
    };
    addresses.filter(|address| !is_local(address)).collect()
}

/// Ends the thread that serves, however this one ends.
struct Close<'a> {
    over: &'a AtomicBool,
    board: &'a Board,
}

impl Drop for Close<'_> {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        self.board.ring();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::{Order, Progress};
    use std::io;
    use std::net::TcpStream;
    use std::time::Duration;

    fn options(listen: &str) -> WebOptions {
        WebOptions {
            sensors: Vec::new(),
            listen: listen.parse().unwrap(),
            token: None,
            open: false,
            origins: Vec::new(),
            names: Vec::new(),
            token_file: None,
            json: false,
            bounds: Bounds::default(),
            places: Vec::new(),
        }
    }

    #[test]
    fn beyond_this_machine_a_word_is_needed() {
        let stop = AtomicBool::new(true);
        for listen in ["0.0.0.0:0", "[::]:0"] {
            let failure = web(&options(listen), None, &mut Vec::new(), &stop).unwrap_err();
            assert_eq!(failure.kind, Kind::Usage);
            assert_eq!(failure.message, format!("other machines could watch at {listen}"));
            assert!(failure.hint.contains("--token"), "{failure}");
            let open = WebOptions { open: true, ..options(listen) };
            assert!(
                web(&open, None, &mut Vec::new(), &stop).map_err(|failure| failure.kind) != Err(Kind::Usage)
            );
        }
        assert!(web(&options("127.0.0.1:0"), None, &mut Vec::new(), &stop).is_ok());
    }

    #[test]
    fn text_output_shows_how_other_machines_get_access() {
        let stop = AtomicBool::new(true);
        let text = |options: &WebOptions| {
            let mut out = Vec::new();
            web(options, None, &mut out, &stop).unwrap();
            String::from_utf8(out).unwrap()
        };
        let local = text(&options("127.0.0.1:0"));
        let [ready, others] = &local.lines().collect::<Vec<_>>()[..] else { panic!("{local}") };
        assert!(ready.starts_with("ready http://127.0.0.1:"), "{local}");
        assert_eq!(*others, "for other machines: --listen 0.0.0.0:0 --token WORD");
        let token = Some("carrot".to_owned());
        let all = text(&WebOptions { token, names: vec!["robot".to_owned()], ..options("0.0.0.0:0") });
        assert!(all.starts_with("ready http://robot:") && !all.contains("anyone"), "{all}");
        let (token, token_file) = (Some("carrot".to_owned()), Some("/etc/word".into()));
        let local = text(&WebOptions { token, token_file, ..options("127.0.0.1:0") });
        assert!(local.ends_with(" --token-file /etc/word\n"), "{local}");
        let open = text(&WebOptions { open: true, ..options("0.0.0.0:0") });
        let warning = "anyone who can reach this address can watch; to restrict that: --token WORD";
        assert_eq!(open.lines().last(), Some(warning), "{open}");
        let json = text(&WebOptions { json: true, ..options("127.0.0.1:0") });
        assert_eq!(json.lines().count(), 1, "{json}");
    }

    /// A player that breaks down over what a viewer wants.
    struct Broken;

    impl Playback for Broken {
        fn order(&self, order: Order) {
            panic!("nobody can {order:?}");
        }

        fn progress(&self) -> Progress {
            let (position_s, length_s, rate) = (0.0, None, None);
            Progress { position_s, length_s, rate, paused: true, over: false, lap: 0, telegrams: 0 }
        }
    }

    /// Hands on what is written.
    struct Told(mpsc::Sender<String>);

    impl Write for Told {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            let _ = self.0.send(String::from_utf8_lossy(bytes).into_owned());
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    /// Orders something of the server at `address`, as the page does.
    fn order(address: &str) -> io::Result<TcpStream> {
        let mut viewer = TcpStream::connect(address)?;
        let upgrade = "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\
                       Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Protocol: foxglove.sdk.v1";
        write!(viewer, "GET / HTTP/1.1\r\nHost: {address}\r\n{upgrade}\r\n\r\n")?;
        let words = br#"{"op":"scanhub.player","order":"step"}"#;
        // A text in one frame, masked by zeros.
        viewer.write_all(&[&[0x81, 0x80 | words.len() as u8, 0, 0, 0, 0], &words[..]].concat())?;
        Ok(viewer)
    }

    #[test]
    fn where_the_thread_that_serves_dies_the_verb_ends_and_says_so() {
        let (tell, told) = mpsc::channel();
        let stop = AtomicBool::new(false);
        let (ordered, end) = thread::scope(|scope| {
            let verb = scope.spawn(|| web(&options("127.0.0.1:0"), Some(&Broken), &mut Told(tell), &stop));
            let ready = told.recv_timeout(Duration::from_secs(60)).unwrap_or_default();
            let address = ready.lines().next().unwrap_or_default();
            let ordered = order(address.trim().trim_start_matches("ready http://").trim_end_matches('/'));
            // Else it would serve on for ever.
            stop.store(ordered.is_err(), Ordering::Relaxed);
            (ordered, verb.join().unwrap())
        });
        assert!(ordered.is_ok(), "{ordered:?}");
        let failure = end.unwrap_err();
        assert_eq!((failure.kind, &failure.message[..]), (Kind::Failed, "what serves the viewers ended"));
        assert_eq!(failure.hint, "start it again");
    }

    #[test]
    fn urls_have_the_token_and_every_address() {
        let names = ["robot".to_owned()];
        let reachable = ["192.168.1.7", "2001:db8::7"].map(|address| address.parse().unwrap());
        let of =
            |listen: &str, names: &[String], token| urls(listen.parse().unwrap(), &reachable, names, token);
        assert_eq!(of("127.0.0.1:8080", &names, None), ["http://127.0.0.1:8080/"]);
        assert_eq!(of("127.0.0.1:8080", &names, Some("carrot")), ["http://127.0.0.1:8080/?token=carrot"]);
        assert_eq!(of("0.0.0.0:8080", &names, None), ["http://robot:8080/", "http://192.168.1.7:8080/"]);
        let all = ["http://192.168.1.7:8080/?token=x", "http://[2001:db8::7]:8080/?token=x"];
        assert_eq!(of("[::]:8080", &[], Some("x")), all);
        assert_eq!(urls("0.0.0.0:8080".parse().unwrap(), &[], &[], None), ["http://0.0.0.0:8080/"]);
    }

    #[test]
    fn a_token_that_no_address_shows_is_refused() {
        for token in ["", " ", "a&b", "a#b", "ö", "100%"] {
            let stop = AtomicBool::new(true);
            let options = WebOptions { token: Some(token.to_owned()), ..options("127.0.0.1:0") };
            let failure = web(&options, None, &mut Vec::new(), &stop).unwrap_err();
            assert_eq!(failure.kind, Kind::Usage, "{token:?}");
        }
    }
}
