//! `scanhub web`: the live picture for browsers and for viewers of `foxglove.sdk.v1`. The main thread subscribes to the
//! hub and publishes on channels. Another thread serves these channels.

mod channels;
mod feed;

use std::fmt;
use std::io::Write;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver, TryRecvError};
use std::thread;
use std::time::{Duration, Instant};

use clap::Args;
use nix::ifaddrs::getifaddrs;
use nix::net::if_::InterfaceFlags;
use scanhub_files::regular_file;
use scanhub_schema::{Failure, Kind, PublisherKind, check_any_sensor};
use scanhub_shm::Domain;
use scanhub_verbs::RunLimits;
use scanhub_verbs::follow::TopicRun;
use scanhub_verbs::names::{TopicName, as_argument};
use scanhub_verbs::output::{ExitReason, Output, verb_result};
use serde::Serialize;

use crate::live_scene::{TOPICS, topics_to_follow};
use crate::server::player::Playback;
use crate::server::{AccessPolicy, ChannelStore, Event, Server, ViewerEvent};
use feed::Feed;

/// Serve the live picture to browsers, and to Foxglove and Lichtblick
#[derive(Args, Clone, Debug)]
#[command(after_help = AFTER_HELP)]
pub struct WebArgs {
    /// Sensors to show [default: all]
    #[arg(value_name = "SENSOR")]
    sensors: Vec<String>,
    /// Address to listen on: an IP address or localhost, a port, or both. If the port is in use, the next free port is
    /// taken. For viewers on other machines, use 0.0.0.0 or ::, with --token, --token-file or --open
    #[arg(long, default_value = "127.0.0.1:8080", value_name = "ADDRESS:PORT", value_parser = listen_address)]
    listen: SocketAddr,
    /// Word that viewers need, as ?token=WORD in the address. The network carries it unencrypted. Other users of this
    /// machine can see this flag in the list of processes, but not the variable, and not the file of --token-file
    #[arg(long, value_name = "WORD", env = "SCANHUB_WEB_TOKEN", hide_env_values = true, value_parser = token)]
    token: Option<String>,
    /// File that only this user can read, with the word as its only line. It takes precedence over --token
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Serve everyone who can reach the address, without a token
    #[arg(long, conflicts_with_all = ["token", "token_file"])]
    open: bool,
    /// Web site whose pages may connect, as a URL. Can be repeated
    #[arg(long = "allow-origin", value_name = "URL")]
    origins: Vec<String>,
    /// Recording to show: MCAP file, stream file or CARMEN log, plain or gzipped. A private hub plays it, and keys of
    /// the page control the player
    #[arg(long, value_name = "FILE")]
    pub replay: Option<PathBuf>,
    /// Start the recording again at its end
    #[arg(long = "loop", requires = "replay")]
    pub is_looped: bool,
    #[command(flatten)]
    limits: RunLimits,
}

const AFTER_HELP: &str = "\
Examples:
  scanhub web
  scanhub web --listen 8090
  scanhub web --listen 0.0.0.0 --token carrot

Open the printed address in a browser. In Foxglove or Lichtblick, open a connection of the type Foxglove WebSocket to this
address, with ws: in place of http:.";

/// Port if `--listen` names only an address.
const DEFAULT_PORT: u16 = 8080;
/// Maximum size of a file with a token, in bytes.
const MAX_TOKEN_FILE: u64 = 4096;
/// Minimum interval between two reports of a topic that is not served.
const REPORT_INTERVAL: Duration = Duration::from_secs(10);

impl WebArgs {
    /// Checks the file with the token, so that its errors are reported before a recording is opened.
    ///
    /// # Errors
    ///
    /// [`Kind::Input`] or [`Kind::Configuration`] if the token cannot be read from its file.
    pub fn check(&self) -> Result<(), Failure> {
        self.token().map(drop)
    }

    fn token(&self) -> Result<Option<String>, Failure> {
        match &self.token_file {
            Some(file) => read_token(file).map(Some),
            None => Ok(self.token.clone()),
        }
    }

    /// Serves the sensors of the first live domain of `locations`, until the limits are reached or `stop` is set.
    /// Prints the URLs, and each viewer that connects or disconnects, to `out`. Viewers control the `player`, if one is
    /// given.
    ///
    /// # Errors
    ///
    /// - [`Kind::Input`] or [`Kind::Configuration`] if the token cannot be read from its file.
    /// - [`Kind::Usage`] if a sensor's name is not valid, or if other machines could connect without a token.
    /// - [`Kind::Failed`] if the server cannot listen, if waiting for its sockets fails, or if its thread panics.
    /// - [`Kind::NoHub`], [`Kind::NoTopic`], [`Kind::Timeout`] and [`Kind::Interrupted`] in the same cases as `scanhub
    ///   echo`.
    pub fn run(
        &self,
        locations: &[Domain],
        json: bool,
        player: Option<&dyn Playback>,
        out: &mut dyn Write,
        stop: &AtomicBool,
    ) -> Result<(), Failure> {
        let token = self.token()?;
        self.sensors.iter().try_for_each(|sensor| as_argument(check_any_sensor(sensor)))?;
        if !self.listen.ip().is_loopback() && token.is_none() && !self.open {
            let what = format!("other machines could watch at {}", self.listen);
            let hint = "set a token for viewers (--token WORD), or allow everyone (--open)";
            return Err(Failure::new(Kind::Usage, what, hint));
        }
        let host = rustix::system::uname().nodename().to_string_lossy().into_owned();
        let policy = AccessPolicy { token, origins: self.origins.clone(), names: vec![host.clone()] };
        let urls = |address| urls(address, &reachable_addresses(), &host, policy.token.as_deref());
        let server = Server::bind(self.listen, policy.clone())?;
        let channels = ChannelStore::new()?;
        let (report, events) = mpsc::channel();
        let mut reporter = Reporter { output: Output::new(out), events, json, next_shortage_report: None };
        if let Err(end) = reporter.ready(&urls(server.address()), self) {
            return verb_result(Err(end));
        }
        let requested_topics =
            [&TOPICS[..], PublisherKind::Mount.topics(), PublisherKind::Tilted.topics()].concat();
        let (names, topics) = topics_to_follow(&self.sensors, &requested_topics, locations);
        let is_over = AtomicBool::new(false);
        thread::scope(|scope| {
            let served = thread::Builder::new()
                .name("web".into())
                // The thread owns `report`, so the end of the thread closes the channel of events.
                .spawn_scoped(scope, {
                    let (server, channels, is_over) = (&server, &channels, &is_over);
                    move || server.run(channels, player, &report, is_over)
                })
                .map_err(|error| Failure::new(Kind::ResourceExhausted, format!("no thread: {error}"), ""))?;
            let closing = StopServer { is_over: &is_over, channels: &channels };
            let mut feed = Feed::new(&channels, locations, player, reporter);
            let following = TopicRun::new(&names, &topics, locations, &self.limits, stop);
            let end = feed.follow(&mut following.tolerating_shortage());
            drop(closing);
            match served.join() {
                Ok(Ok(())) => verb_result(end),
                Ok(Err(failure)) => Err(failure),
                // The panic has printed its reason.
                Err(_) => Err(Failure::new(Kind::Failed, "the server thread ended", "start it again")),
            }
        })
    }
}

/// Parses `ADDRESS:PORT`, an address without a port, or a port without an address. A port alone and `localhost` mean
/// this machine only.
fn listen_address(text: &str) -> Result<SocketAddr, String> {
    let without_brackets = text.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')).unwrap_or(text);
    if let Ok(address) = text.parse() {
        return Ok(address);
    }
    if let Ok(ip) = without_brackets.parse::<IpAddr>() {
        return Ok(SocketAddr::new(ip, DEFAULT_PORT));
    }
    if text == "localhost" {
        return Ok(SocketAddr::from((Ipv4Addr::LOCALHOST, DEFAULT_PORT)));
    }
    let port = text.strip_prefix("localhost:").or_else(|| text.strip_prefix(':')).unwrap_or(text);
    if let Ok(port) = port.parse() {
        return Ok(SocketAddr::from((Ipv4Addr::LOCALHOST, port)));
    }
    Err("use localhost or an IP address, a port, or both, such as 8090, 0.0.0.0 or [::]:8090".to_owned())
}

/// Parses a token. The token must be valid in a URL without escapes.
fn token(text: &str) -> Result<String, String> {
    let is_plain = |sign: char| sign.is_ascii_alphanumeric() || "-._~".contains(sign);
    match !text.is_empty() && text.chars().all(is_plain) {
        true => Ok(text.to_owned()),
        false => Err("letters, digits and - . _ ~".to_owned()),
    }
}

/// Returns the token in `file`.
///
/// # Errors
///
/// [`Kind::Input`] if the file cannot be read, [`Kind::Configuration`] if it contains no token, or if other users can
/// access it.
fn read_token(file: &Path) -> Result<String, Failure> {
    let path_text = file.display().to_string();
    let unreadable = |error: std::io::Error| regular_file::unreadable(&path_text, &error);
    let text = regular_file::read_text(file, MAX_TOKEN_FILE).map_err(unreadable)?;
    let mode = file.metadata().map_err(unreadable)?.mode() & 0o777;
    if mode & 0o077 != 0 {
        let message = format!("{path_text} has mode {mode:04o}, so others can use the token");
        return Err(Failure::new(Kind::Configuration, message, "`chmod 600` it"));
    }
    token(text.trim_end()).map_err(|expected| {
        let hint = format!("one line with one word: {expected}");
        Failure::new(Kind::Configuration, format!("{path_text} contains no token"), hint)
    })
}

/// Returns the URLs of the page. If the server listens on all addresses, the first URL has the name of this machine, if
/// `host` is not empty. The other URLs have the addresses in `reachable` that the server accepts.
fn urls(address: SocketAddr, reachable: &[IpAddr], host: &str, token: Option<&str>) -> Vec<String> {
    let token = token.map(|token| format!("?token={token}")).unwrap_or_default();
    let of = |host: &dyn fmt::Display| format!("http://{host}/{token}");
    if !address.ip().is_unspecified() {
        return vec![of(&address)];
    }
    let port = address.port();
    let name = (!host.is_empty()).then(|| of(&format!("{host}:{port}")));
    // A socket for all IPv6 addresses accepts IPv4 too.
    let accepted = reachable.iter().filter(|one| address.is_ipv6() || one.is_ipv4());
    let urls: Vec<String> =
        name.into_iter().chain(accepted.map(|one| of(&SocketAddr::new(*one, port)))).collect();
    if urls.is_empty() { vec![of(&address)] } else { urls }
}

/// Returns the addresses by which other machines can reach this machine. The list is empty if the system does not
/// report them. Omits link-local IPv6 addresses, because a browser would also need the name of an interface.
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

/// Guard that ends the server's thread when it is dropped, even by a panic.
struct StopServer<'a> {
    is_over: &'a AtomicBool,
    channels: &'a ChannelStore,
}

impl Drop for StopServer<'_> {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        self.channels.wake();
    }
}

/// Printer of the lines of `web`.
struct Reporter<'a> {
    output: Output<'a>,
    /// Events of the server.
    events: Receiver<Event>,
    json: bool,
    /// Earliest time of the next report of a topic that is not served.
    next_shortage_report: Option<Instant>,
}

impl Reporter<'_> {
    /// Prints the URLs of the page. As text, also prints a note about access. For a local address, the note has the
    /// flags for access from other machines. With `--open`, it is a warning.
    fn ready(&mut self, urls: &[String], args: &WebArgs) -> Result<(), ExitReason> {
        #[derive(Serialize)]
        struct ReadyJson<'a> {
            class: &'static str,
            url: &'a str,
            urls: &'a [String],
            pid: u32,
        }
        let url = urls.first().map_or("", String::as_str);
        if self.json {
            return self.output.json(&ReadyJson { class: "ready", url, urls, pid: std::process::id() });
        }
        self.output.line(|line| write!(line, "ready {url}"))?;
        if let [_, others @ ..] = urls
            && !others.is_empty()
        {
            self.output.line(|line| write!(line, "or {}", others.join(" ")))?;
        }
        if !args.listen.ip().is_loopback() {
            if !args.open {
                return Ok(());
            }
            let warning = "anyone who can reach this address can watch; to restrict that: --token WORD";
            return self.output.line(|line| write!(line, "{warning}"));
        }
        let port = match args.listen.port() {
            DEFAULT_PORT => String::new(),
            port => format!(":{port}"),
        };
        let token = match (&args.token_file, &args.token) {
            (Some(file), _) => format!("--token-file {}", file.display()),
            (None, token) => format!("--token {}", token.as_deref().unwrap_or("WORD")),
        };
        self.output.line(|line| write!(line, "for other machines: --listen 0.0.0.0{port} {token}"))
    }

    /// Prints the reason why no hub runs yet, and a hint. With JSON, only viewers get the reason.
    fn no_hub(&mut self, failure: &Failure) -> Result<(), ExitReason> {
        match self.json {
            true => Ok(()),
            false => self.output.line(|line| write!(line, "{}; {}", failure.message, failure.hint)),
        }
    }

    /// Prints the events of the server that have arrived.
    ///
    /// # Errors
    ///
    /// Returns [`ExitReason::ReaderClosed`] if the server has ended. The result of its thread has the reason.
    fn report_events(&mut self) -> Result<(), ExitReason> {
        loop {
            match self.events.try_recv() {
                Ok(Event::Viewer(event)) => self.viewer(&event)?,
                Ok(Event::ResourceExhausted(error)) => {
                    let hint = "raise the limit of descriptors: ulimit -n";
                    self.shortage(&format!("cannot accept viewers: {error}"), hint)?;
                }
                Err(TryRecvError::Empty) => return Ok(()),
                Err(TryRecvError::Disconnected) => return Err(ExitReason::ReaderClosed),
            }
        }
    }

    fn viewer(&mut self, event: &ViewerEvent) -> Result<(), ExitReason> {
        #[derive(Serialize)]
        struct Viewer {
            class: &'static str,
            address: String,
            connected: bool,
            replaced: u64,
            viewers: usize,
        }
        let ViewerEvent { address, connected, replaced, viewers } = *event;
        let word = if connected { "connected" } else { "disconnected" };
        match self.json {
            true => self.output.json(&Viewer {
                class: "viewer",
                address: address.to_string(),
                connected,
                replaced,
                viewers,
            }),
            false => self
                .output
                .line(|line| write!(line, "{address} {word}, {viewers} viewers, {replaced} replaced")),
        }
    }

    /// Prints that a topic is not served because the system lacks a resource, unless a line about a topic that is not
    /// served was printed in the last 10 s.
    fn not_served(&mut self, name: &TopicName, failure: &Failure) -> Result<(), ExitReason> {
        let now = Instant::now();
        if self.next_shortage_report.is_some_and(|at| now < at) {
            return Ok(());
        }
        self.next_shortage_report = Some(now + REPORT_INTERVAL);
        self.shortage(&format!("{name} is not served: {}", failure.message), &failure.hint)
    }

    fn shortage(&mut self, message: &str, hint: &str) -> Result<(), ExitReason> {
        #[derive(Serialize)]
        struct ShortageJson<'a> {
            class: &'static str,
            message: &'a str,
            hint: &'a str,
        }
        match self.json {
            true => self.output.json(&ShortageJson { class: "web_short", message, hint }),
            false => self.output.line(|line| write!(line, "{message}; {hint}")),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io;
    use std::net::TcpStream;
    use std::os::unix::fs::OpenOptionsExt;

    use super::*;
    use crate::server::player::{PlayerCommand, Progress};

    fn args(listen: &str) -> WebArgs {
        WebArgs {
            sensors: Vec::new(),
            listen: listen.parse().unwrap(),
            token: None,
            token_file: None,
            open: false,
            origins: Vec::new(),
            replay: None,
            is_looped: false,
            limits: RunLimits::default(),
        }
    }

    fn run(args: &WebArgs, json: bool) -> (Result<(), Failure>, String) {
        let mut out = Vec::new();
        let result = args.run(&[], json, None, &mut out, &AtomicBool::new(true));
        (result, String::from_utf8(out).unwrap())
    }

    #[test]
    fn other_machines_need_a_token() {
        for listen in ["0.0.0.0:0", "[::]:0"] {
            let failure = run(&args(listen), false).0.unwrap_err();
            assert_eq!(failure.kind, Kind::Usage);
            assert_eq!(failure.message, format!("other machines could watch at {listen}"));
            assert!(failure.hint.contains("--token"), "{failure}");
            let open = WebArgs { open: true, ..args(listen) };
            assert_ne!(run(&open, false).0.map_err(|failure| failure.kind), Err(Kind::Usage));
        }
        assert!(run(&args("127.0.0.1:0"), false).0.is_ok());
    }

    #[test]
    fn text_output_shows_how_other_machines_get_access() {
        let text = |args: &WebArgs| {
            let (result, text) = run(args, false);
            result.map(|()| text).unwrap()
        };
        let local = text(&args("127.0.0.1:0"));
        let [ready, others] = &local.lines().collect::<Vec<_>>()[..] else { panic!("{local}") };
        assert!(ready.starts_with("ready http://127.0.0.1:"), "{local}");
        assert_eq!(*others, "for other machines: --listen 0.0.0.0:0 --token WORD");
        let token = Some("carrot".to_owned());
        let all = text(&WebArgs { token, ..args("0.0.0.0:0") });
        let uname = rustix::system::uname();
        let ready = format!("ready http://{}:", uname.nodename().to_string_lossy());
        assert!(all.starts_with(&ready) && all.contains("?token=carrot") && !all.contains("anyone"), "{all}");
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("word");
        let mut writer =
            std::fs::OpenOptions::new().write(true).create_new(true).mode(0o600).open(&file).unwrap();
        writer.write_all(b"carrot\n").unwrap();
        let local = text(&WebArgs { token_file: Some(file.clone()), ..args("127.0.0.1:0") });
        assert!(local.contains("?token=carrot"), "{local}");
        assert!(local.ends_with(&format!(" --token-file {}\n", file.display())), "{local}");
        let open = text(&WebArgs { open: true, ..args("0.0.0.0:0") });
        let warning = "anyone who can reach this address can watch; to restrict that: --token WORD";
        assert_eq!(open.lines().last(), Some(warning), "{open}");
        let json = run(&args("127.0.0.1:0"), true).1;
        assert_eq!(json.lines().count(), 1, "{json}");
    }

    /// Player that panics at any command.
    struct BrokenPlayer;

    impl Playback for BrokenPlayer {
        fn command(&self, command: PlayerCommand) {
            panic!("cannot {command:?}");
        }

        fn progress(&self) -> Progress {
            Progress { paused: true, ..Progress::default() }
        }
    }

    /// Writer that sends each write to a channel.
    struct Lines(mpsc::Sender<String>);

    impl Write for Lines {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            let _ = self.0.send(String::from_utf8_lossy(bytes).into_owned());
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    /// Sends a command to the player of the server at `address`, as the page does.
    fn send_command(address: &str) -> io::Result<TcpStream> {
        let mut viewer = TcpStream::connect(address)?;
        let upgrade = "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\
                       Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Protocol: foxglove.sdk.v1";
        write!(viewer, "GET / HTTP/1.1\r\nHost: {address}\r\n{upgrade}\r\n\r\n")?;
        let message = br#"{"op":"scanhub.player","order":"step"}"#;
        // One text frame, with a mask of zeros.
        viewer.write_all(&[&[0x81, 0x80 | message.len() as u8, 0, 0, 0, 0], &message[..]].concat())?;
        Ok(viewer)
    }

    #[test]
    fn server_panic_ends_the_verb_with_a_failure() {
        let (lines, received) = mpsc::channel();
        let stop = AtomicBool::new(false);
        let (sent, end) = thread::scope(|scope| {
            let verb = scope
                .spawn(|| args("127.0.0.1:0").run(&[], false, Some(&BrokenPlayer), &mut Lines(lines), &stop));
            let ready = received.recv_timeout(Duration::from_secs(60)).unwrap_or_default();
            let address = ready.lines().next().unwrap_or_default();
            let sent = send_command(address.trim().trim_start_matches("ready http://").trim_end_matches('/'));
            // Stop the verb if the command could not be sent, because the verb would not end by itself.
            stop.store(sent.is_err(), Ordering::Relaxed);
            (sent, verb.join().unwrap())
        });
        assert!(sent.is_ok(), "{sent:?}");
        let failure = end.unwrap_err();
        assert_eq!((failure.kind, &failure.message[..]), (Kind::Failed, "the server thread ended"));
        assert_eq!(failure.hint, "start it again");
    }

    #[test]
    fn urls_have_the_token_and_every_address() {
        let reachable = ["192.168.1.7", "2001:db8::7"].map(|address| address.parse().unwrap());
        let of = |listen: &str, host: &str, token| urls(listen.parse().unwrap(), &reachable, host, token);
        assert_eq!(of("127.0.0.1:8080", "robot", None), ["http://127.0.0.1:8080/"]);
        assert_eq!(of("127.0.0.1:8080", "robot", Some("carrot")), ["http://127.0.0.1:8080/?token=carrot"]);
        assert_eq!(of("0.0.0.0:8080", "robot", None), ["http://robot:8080/", "http://192.168.1.7:8080/"]);
        let all = ["http://192.168.1.7:8080/?token=x", "http://[2001:db8::7]:8080/?token=x"];
        assert_eq!(of("[::]:8080", "", Some("x")), all);
        assert_eq!(urls("0.0.0.0:8080".parse().unwrap(), &[], "", None), ["http://0.0.0.0:8080/"]);
    }

    #[test]
    fn refuses_tokens_that_change_in_a_url() {
        for text in ["", " ", "a&b", "a#b", "ö", "100%"] {
            assert!(token(text).is_err(), "{text:?}");
        }
        assert_eq!(token("a-Z_0.~"), Ok("a-Z_0.~".to_owned()));
    }

    #[test]
    fn listen_takes_a_port_an_address_or_both() {
        for (text, expected) in [
            ("8090", "127.0.0.1:8090"),
            ("0", "127.0.0.1:0"),
            (":8090", "127.0.0.1:8090"),
            ("localhost:8090", "127.0.0.1:8090"),
            ("localhost", "127.0.0.1:8080"),
            ("0.0.0.0", "0.0.0.0:8080"),
            ("::", "[::]:8080"),
            ("[::]", "[::]:8080"),
            ("::1", "[::1]:8080"),
            ("192.168.1.7", "192.168.1.7:8080"),
            ("0.0.0.0:8090", "0.0.0.0:8090"),
            ("[::]:8090", "[::]:8090"),
        ] {
            assert_eq!(listen_address(text), Ok(expected.parse().unwrap()), "{text}");
        }
        for bad in [
            "",
            "65536",
            "-1",
            ":",
            "localhost:",
            "::8090x",
            "robot",
            "robot:8090",
            "0.0.0.0:",
            "1.2.3",
            "[0.0.0.0",
            "http://0.0.0.0",
        ] {
            assert!(listen_address(bad).is_err(), "{bad}");
        }
    }
}
