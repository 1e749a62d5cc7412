//! Zenoh's configuration. It consists of the user's configuration file, the given addresses, and limits for settings
//! that the file does not contain. Listening and scouting are off unless the options or the file enable them.

use std::path::Path;

use scanhub_files::regular_file;
use scanhub_schema::{Failure, Kind};
use x509_parser::pem::Pem;
use zenoh::Config;
use zenoh::config::{EndPoint, WhatAmI};

use super::log::without_locations;
use crate::BridgeOptions;

/// A checked configuration.
#[derive(Debug)]
pub(crate) struct CheckedConfig {
    config: Config,
    listens: bool,
}

/// Keys of Zenoh's configuration, and the JSON values that the keys get if the file does not set them.
///
/// Zenoh's defaults are chosen for throughput. On a slow link, samples become old in the long queues of Zenoh. With
/// these limits, a message for which a link has no room waits in this process, where newer samples replace older ones.
/// A router on the path has its own settings.
const LIMITS: &[(&str, &str)] = &[
    ("scouting/multicast/enabled", "false"),
    ("scouting/gossip/enabled", "false"),
    ("connect/retry", r#"{"period_init_ms": 100, "period_max_ms": 400, "period_increase_factor": 2}"#),
    ("transport/unicast/open_timeout", "3000"),
    ("transport/unicast/accept_timeout", "3000"),
    ("transport/unicast/accept_pending", "32"),
    ("transport/unicast/max_sessions", "64"),
    ("transport/link/tx/batch_size", "8192"),
    ("transport/link/tx/queue/size/data", "1"),
    // Without batching, a sample is sent at once, as with Zenoh's `express`. But `express` would also apply on the
    // routers of the path, which have room for only two batches, and drop the third batch.
    ("transport/link/tx/queue/batching/enabled", "false"),
    ("transport/link/rx/max_message_size", "1048576"),
    ("transport/link/tcp/so_sndbuf", "8192"),
    ("transport/link/tls/so_sndbuf", "8192"),
];

/// Maximum time for which a message waits for room before Zenoh drops it, in microseconds. The first value is for a
/// client, and the second for a router or peer. After a drop, Zenoh drops later messages too, until there is room. The
/// second key is the additional time for a message in fragments.
///
/// A client has one link. It waits for 10 s, because Zenoh closes a link on which no data arrives after 10 s. Messages
/// of a client are therefore dropped only if the link breaks. A longer wait would delay the detection of a dead link,
/// because the waiting thread holds a lock of Zenoh. A router may have many links, and a stalled link must not delay
/// the others.
const WAIT_SETTINGS: [(&str, [&str; 2]); 2] = [
    ("transport/link/tx/queue/congestion_control/drop/wait_before_drop", ["10000000", "1000000"]),
    ("transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments", ["0", "2000000"]),
];

/// Keys of the configuration that name files, each with the content that the file must have. Zenoh opens these files
/// only when it connects.
const FILES: &[(&str, Content)] = &[
    ("transport/link/tls/root_ca_certificate", Content::Trusted),
    ("transport/link/tls/listen_certificate", Content::Own),
    ("transport/link/tls/listen_private_key", Content::Key),
    ("transport/link/tls/connect_certificate", Content::Own),
    ("transport/link/tls/connect_private_key", Content::Key),
    ("transport/auth/usrpwd/dictionary_file", Content::Users),
];

/// Key that listening with TLS requires.
const CERTIFICATE: &str = "transport/link/tls/listen_certificate";

/// Content of a file that the configuration names.
#[derive(Clone, Copy)]
enum Content {
    Trusted,
    Own,
    Key,
    Users,
}

impl CheckedConfig {
    /// Reads and checks the configuration for these `options`. `now_s` is the time in seconds since 1970.
    ///
    /// # Errors
    ///
    /// [`Kind::Input`] if the file cannot be read. [`Kind::Configuration`] if the file or an address is invalid, if
    /// there is neither a router nor an address to listen on, or if a certificate has expired.
    pub(crate) fn read(options: &BridgeOptions, now_s: i64) -> Result<CheckedConfig, Failure> {
        let mut config = options.config.as_deref().map_or_else(|| Ok(Config::default()), read)?;
        let defaults = Config::default();
        let is_set = |config: &Config, key: &str| config.get_json(key).ok() != defaults.get_json(key).ok();
        let uses_default_endpoints = !is_set(&config, "listen/endpoints");
        let configured =
            config.get_json("mode").ok().and_then(|text| serde_json::from_str::<WhatAmI>(&text).ok());
        let mode = match configured {
            _ if !options.listen.is_empty() => WhatAmI::Router,
            Some(mode) => mode,
            None => WhatAmI::Client,
        };
        set(&mut config, "mode", &format!("{:?}", mode.to_str()));
        let mut listen = if uses_default_endpoints { Vec::new() } else { endpoints(&config, "listen", mode) };
        listen.extend(check_endpoints("--listen", &options.listen)?);
        let mut connect = endpoints(&config, "connect", mode);
        connect.extend(check_endpoints("--connect", &options.connect)?);
        let is_silent = config.get_json("scouting/multicast/enabled").is_ok_and(|text| text != "true");
        if listen.is_empty() && connect.is_empty() && is_silent {
            let hint = "name one (--connect tcp/HOST:7447), or accept connections (--listen tcp/0.0.0.0:7447); \
                        --config FILE can do both";
            return Err(Failure::new(Kind::Configuration, "no router", hint));
        }
        let listens = !listen.is_empty();
        let waits =
            WAIT_SETTINGS.iter().map(|(key, values)| (*key, values[usize::from(mode != WhatAmI::Client)]));
        for (key, value) in LIMITS.iter().copied().chain(waits) {
            if !is_set(&config, key) {
                set(&mut config, key, value);
            }
        }
        for (key, endpoints) in [("listen/endpoints", &listen), ("connect/endpoints", &connect)] {
            let list: Vec<_> = endpoints.iter().map(|endpoint| format!("{endpoint:?}")).collect();
            set(&mut config, key, &format!("[{}]", list.join(",")));
        }
        let has = |key: &str| is_set(&config, key) || is_set(&config, &format!("{key}_base64"));
        let of_tls = listen.iter().find(|endpoint| endpoint.starts_with("tls/"));
        if let Some(endpoint) = of_tls.filter(|_| !has(CERTIFICATE)) {
            let hint =
                format!("--config FILE with {CERTIFICATE} and listen_private_key, as in docs/bridge.md");
            return Err(Failure::new(
                Kind::Configuration,
                format!("{endpoint}: no certificate is named"),
                hint,
            ));
        }
        for &(key, content) in FILES {
            check_file(&config, key, content, now_s)?;
        }
        Ok(CheckedConfig { config, listens })
    }

    /// Returns the configuration for Zenoh.
    pub(super) fn zenoh(&self) -> Config {
        self.config.clone()
    }

    /// Returns whether the session listens.
    pub(super) fn listens(&self) -> bool {
        self.listens
    }
}

fn read(path: &Path) -> Result<Config, Failure> {
    let text = regular_file::read_text(path, regular_file::MAX_FILE_BYTES).map_err(|error| {
        let what = format!("--config {}: cannot read it: {error}", path.display());
        Failure::new(Kind::Input, what, "name a file with Zenoh's own configuration (docs/bridge.md)")
    })?;
    Config::from_json5(&text).map_err(|error| {
        let what = format!("{}: {}", path.display(), without_locations(&error.to_string()));
        let hint = "it is Zenoh's own configuration in JSON5: https://zenoh.io/docs/manual/configuration";
        Failure::new(Kind::Configuration, what, hint)
    })
}

/// Sets a key that this module chooses. A test checks that key and value are valid in Zenoh.
fn set(config: &mut Config, key: &str, value: &str) {
    let set = config.insert_json5(key, value);
    debug_assert!(set.is_ok(), "{key} = {value}: {set:?}");
}

/// Returns the addresses under `key` for this `mode`.
fn endpoints(config: &Config, key: &str, mode: WhatAmI) -> Vec<String> {
    let value = config.get_json(&format!("{key}/endpoints")).unwrap_or_default();
    let value: serde_json::Value = serde_json::from_str(&value).unwrap_or_default();
    let value = if value.is_object() { value[mode.to_str()].clone() } else { value };
    let text = |value: &serde_json::Value| value.as_str().map(str::to_owned);
    value.as_array().map(|all| all.iter().filter_map(text).collect()).unwrap_or_default()
}

fn check_endpoints(flag: &str, texts: &[String]) -> Result<Vec<String>, Failure> {
    let check = |text: &String| {
        let refuse = |why: &str| {
            let hint = "tcp/HOST:PORT or tls/HOST:PORT, for example tcp/192.0.2.7:7447";
            Failure::new(Kind::Configuration, format!("{flag} {text}: {why}"), hint)
        };
        let endpoint: EndPoint =
            text.parse().map_err(|error| refuse(&without_locations(&format!("{error}"))))?;
        match endpoint.protocol().as_str() {
            "tcp" | "tls" => Ok(text.clone()),
            other => Err(refuse(&format!("{other} is not built in"))),
        }
    };
    texts.iter().map(check).collect()
}

fn check_file(config: &Config, key: &str, content: Content, now_s: i64) -> Result<(), Failure> {
    let configured =
        config.get_json(key).ok().and_then(|text| serde_json::from_str::<Option<String>>(&text).ok());
    let Some(path) = configured.flatten() else { return Ok(()) };
    let refuse = |why: String, remedy: &str| {
        Failure::new(Kind::Configuration, format!("{key}: {path}: {why}"), remedy)
    };
    let text = regular_file::read(Path::new(&path), regular_file::MAX_FILE_BYTES)
        .map_err(|error| refuse(format!("cannot read it: {error}"), "see --config"))?;
    match content {
        Content::Trusted => check_trusted(&text, now_s),
        Content::Own => check_own(&text, now_s),
        Content::Key => check_key(&text),
        Content::Users => Ok(()),
    }
    .map_err(|UnusableFile { reason: why, remedy }| refuse(why, remedy))
}

/// Reason why a certificate or key file cannot be used. This module checks the files, because Zenoh opens them only
/// when it connects. For an expired certificate, Zenoh then reports only the message of the peer.
struct UnusableFile {
    reason: String,
    remedy: &'static str,
}

/// Checks that the first certificate in `text` is valid at the time `now_s`, in seconds since 1970. This machine
/// presents this certificate to others.
fn check_own(text: &[u8], now_s: i64) -> Result<(), UnusableFile> {
    check_validity(&certificates(text)?[0], now_s)
}

/// Checks that at least one certificate in `text` is valid at the time `now_s`, in seconds since 1970. This machine
/// trusts these certificates. Other certificates in `text` may have expired.
fn check_trusted(text: &[u8], now_s: i64) -> Result<(), UnusableFile> {
    let certificates = certificates(text)?;
    let is_good = certificates[1..].iter().any(|block| check_validity(block, now_s).is_ok());
    check_validity(&certificates[0], now_s).or_else(|unusable| if is_good { Ok(()) } else { Err(unusable) })
}

/// Checks that `text` contains a private key.
fn check_key(text: &[u8]) -> Result<(), UnusableFile> {
    if blocks(text)?.iter().any(|block| block.label.ends_with("PRIVATE KEY")) {
        return Ok(());
    }
    Err(UnusableFile { reason: "there is no private key in it".into(), remedy: NO_PEM })
}

/// Remedy for a file without the certificate or key that it must have.
const NO_PEM: &str = "it has to be a file in PEM, as openssl writes it (docs/bridge.md)";

/// Returns the certificates in `text`, at least one.
fn certificates(text: &[u8]) -> Result<Vec<Pem>, UnusableFile> {
    let mut blocks = blocks(text)?;
    blocks.retain(|block| block.label == "CERTIFICATE");
    if blocks.is_empty() {
        return Err(UnusableFile { reason: "there is no certificate in it".into(), remedy: NO_PEM });
    }
    Ok(blocks)
}

fn check_validity(block: &Pem, now_s: i64) -> Result<(), UnusableFile> {
    let certificate = block.parse_x509().map_err(|error| {
        let why = format!("it has a certificate that cannot be read: {error}");
        UnusableFile { reason: why, remedy: NO_PEM }
    })?;
    let (validity, subject) = (certificate.validity(), certificate.subject());
    if now_s > validity.not_after.timestamp() {
        let why = format!("the certificate of {subject} expired at {}", validity.not_after);
        return Err(UnusableFile { reason: why, remedy: "renew it, as docs/bridge.md shows" });
    }
    if now_s < validity.not_before.timestamp() {
        let why = format!("the certificate of {subject} is not valid before {}", validity.not_before);
        return Err(UnusableFile {
            reason: why,
            remedy: "set the clock of this machine, or of the one that created the certificate",
        });
    }
    Ok(())
}

fn blocks(text: &[u8]) -> Result<Vec<Pem>, UnusableFile> {
    let blocks: Result<Vec<Pem>, _> = Pem::iter_from_buffer(text).collect();
    blocks.map_err(|error| UnusableFile { reason: format!("it cannot be read: {error}"), remedy: NO_PEM })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Arbitrary time, because other tests check the validity of certificates.
    const NOW_S: i64 = 0;

    fn options(connect: &[&str], listen: &[&str], config: Option<&Path>) -> BridgeOptions {
        let texts = |all: &[&str]| all.iter().map(|&text| text.to_owned()).collect();
        BridgeOptions {
            connect: texts(connect),
            listen: texts(listen),
            config: config.map(Path::to_path_buf),
            send: None,
            publish: None,
            ros2: None,
            json: false,
        }
    }

    fn json_value(prepared: &CheckedConfig, key: &str) -> String {
        prepared.config.get_json(key).unwrap()
    }

    /// Reads a configuration file with this `text`.
    fn read_file(name: &str, text: &str, connect: &[&str]) -> Result<CheckedConfig, Failure> {
        let file = tempfile::Builder::new().suffix(name).tempfile().unwrap();
        std::fs::write(&file, text).unwrap();
        CheckedConfig::read(&options(connect, &[], Some(file.path())), NOW_S)
    }

    #[test]
    fn neither_listens_nor_scouts_unless_configured() {
        let client = CheckedConfig::read(&options(&["tcp/127.0.0.1:7447"], &[], None), NOW_S).unwrap();
        assert_eq!(json_value(&client, "mode"), r#""client""#);
        assert_eq!(json_value(&client, "listen/endpoints"), "[]");
        assert_eq!(json_value(&client, "connect/endpoints"), r#"["tcp/127.0.0.1:7447"]"#);
        let router = CheckedConfig::read(&options(&[], &["tcp/127.0.0.1:0"], None), NOW_S).unwrap();
        assert_eq!((json_value(&router, "mode"), router.listens()), (r#""router""#.into(), true));
        for (prepared, wait) in [(&client, 0), (&router, 1)] {
            for (key, value) in LIMITS.iter().filter(|(key, _)| *key != "connect/retry") {
                assert_eq!(json_value(prepared, key), *value, "{key}");
            }
            for (key, values) in WAIT_SETTINGS {
                assert_eq!(json_value(prepared, key), values[wait], "{key}");
            }
        }
        let failure = CheckedConfig::read(&options(&[], &[], None), NOW_S).unwrap_err();
        assert!(failure.kind == Kind::Configuration && failure.hint.contains("--listen"), "{failure}");
    }

    #[test]
    fn file_settings_are_kept_and_flags_add_endpoints() {
        let text = "{ connect: { endpoints: ['tcp/10.0.0.1:1'] }, transport: { link: { tx: { batch_size: 4096 } } } }";
        let read = read_file("adds", text, &["tcp/10.0.0.2:2"]).unwrap();
        assert_eq!(json_value(&read, "connect/endpoints"), r#"["tcp/10.0.0.1:1","tcp/10.0.0.2:2"]"#);
        assert_eq!(
            (json_value(&read, "transport/link/tx/batch_size"), json_value(&read, "mode")),
            ("4096".into(), r#""client""#.into())
        );
        let peer =
            read_file("peer", "{ mode: 'peer', scouting: { multicast: { enabled: true } } }", &[]).unwrap();
        assert_eq!(
            (json_value(&peer, "mode"), json_value(&peer, "listen/endpoints")),
            (r#""peer""#.into(), "[]".into())
        );
        assert_eq!(json_value(&peer, "scouting/multicast/enabled"), "true");
    }

    #[test]
    fn impossible_configurations_are_refused() {
        let kind = |read: Result<CheckedConfig, Failure>| read.map(drop).map_err(|failure| failure.kind);
        let missing = CheckedConfig::read(&options(&[], &[], Some(Path::new("/nowhere/zenoh.json5"))), NOW_S);
        assert_eq!(kind(missing), Err(Kind::Input));
        for text in ["{ mode: 'king' }", "{ mode: ", "{ no_such_key: 1 }"] {
            let failure = read_file("wrong", text, &["tcp/10.0.0.1:1"]).unwrap_err();
            assert!(
                failure.kind == Kind::Configuration && failure.message.contains("wrong"),
                "{text}: {failure}"
            );
        }
        let bare = CheckedConfig::read(&options(&[], &["tls/127.0.0.1:0"], None), NOW_S).unwrap_err();
        assert!(bare.kind == Kind::Configuration && bare.hint.contains("listen_certificate"), "{bare}");
        for address in ["nonsense", "udp/10.0.0.1:1", "quic/10.0.0.1:1", ""] {
            assert_eq!(
                kind(CheckedConfig::read(&options(&[address], &[], None), NOW_S)),
                Err(Kind::Configuration),
                "{address}"
            );
        }
        let text = "{ transport: { link: { tls: { root_ca_certificate: '/nowhere/ca.pem' } } } }";
        let failure = read_file("ca", text, &["tls/10.0.0.1:1"]).unwrap_err();
        assert_eq!(failure.kind, Kind::Configuration);
        assert!(
            failure.message.contains("/nowhere/ca.pem") && failure.message.contains("root_ca"),
            "{failure}"
        );
    }

    /// Certificate from openssl for CN=robot, valid from 2026-01-01 to 2026-01-02.
    const CERTIFICATE: &[u8] = include_bytes!("certificate/expired.pem");
    /// 2026-01-01 in seconds since 1970.
    const SINCE_S: i64 = 1_767_225_600;
    const DAY_S: i64 = 86_400;

    #[test]
    fn certificate_is_valid_from_first_to_last_second() {
        let refused = |now_s| check_own(CERTIFICATE, now_s).err().map(|unusable| unusable.reason);
        assert_eq!([SINCE_S, SINCE_S + DAY_S].map(refused), [None, None]);
        let expired = refused(SINCE_S + DAY_S + 1).unwrap();
        assert_eq!(expired, "the certificate of CN=robot expired at Jan  2 00:00:00 2026 +00:00");
        let early = refused(SINCE_S - 1).unwrap();
        assert_eq!(early, "the certificate of CN=robot is not valid before Jan  1 00:00:00 2026 +00:00");
    }

    #[test]
    fn missing_certificates_and_keys_are_reported() {
        let why = |unusable: Result<(), UnusableFile>| unusable.err().map(|unusable| unusable.reason);
        assert_eq!(why(check_key(CERTIFICATE)).as_deref(), Some("there is no private key in it"));
        let key = b"-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n";
        assert_eq!(why(check_key(key)), None);
        let none = why(check_trusted(key, SINCE_S));
        assert_eq!(none.as_deref(), Some("there is no certificate in it"));
        assert!(why(check_trusted(b"nonsense\n", SINCE_S)).is_some());
        let cut = &CERTIFICATE[..CERTIFICATE.len() / 2];
        assert!(why(check_trusted(cut, SINCE_S)).is_some());
        let torn = b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n";
        assert!(why(check_trusted(torn, SINCE_S)).unwrap().contains("cannot be read"));
    }
}
