//! A Zenoh session, independent of scanhub's topics. A background thread opens the session. The session creates
//! publishers, tokens, subscribers and queryables, and reports the events of its links. Payloads are bytes.

mod config;
mod log;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use scanhub_schema::{Failure, Kind};
use zenoh::config::WhatAmI;
use zenoh::key_expr::KeyExpr;
use zenoh::liveliness::LivelinessToken;
use zenoh::qos::CongestionControl;
use zenoh::query::{Query, QueryConsolidation, QueryTarget};
use zenoh::sample::{Locality, Sample, SampleKind};
use zenoh::{Session, Wait};

pub(crate) use config::CheckedConfig;
use log::{Log, without_locations};

/// A session that a background thread opens.
pub(crate) struct Connection {
    state: Arc<State>,
    log: Log,
    /// Whether the session listens. A session that listens opens at once or fails.
    listens: bool,
    /// Set once the bridge has reported that it is ready. Before that, no sample is received or sent.
    has_begun: AtomicBool,
    was_linked: Mutex<Option<bool>>,
}

#[derive(Default)]
struct State {
    session: OnceLock<ZenohSession>,
    failure: Mutex<Option<Failure>>,
}

/// An event of the links.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum LinkEvent {
    /// The session has a link, after it had no link.
    Up,
    /// The session has no more links.
    Down,
    /// A connection failed, with Zenoh's message.
    Failing(String),
}

/// Interval between attempts to open a session.
const RETRY_INTERVAL: Duration = Duration::from_millis(300);
/// Time limit for closing a session.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(1);
/// Interval at which a waiting thread checks for the session.
const POLL_INTERVAL: Duration = Duration::from_millis(5);

impl Connection {
    /// Starts a thread that opens a session with this configuration. The thread retries until the session is open. A
    /// session that listens is tried only once.
    pub(crate) fn open(config: CheckedConfig) -> Result<Connection, Failure> {
        let log = Log::install();
        let (state, listens) = (Arc::new(State::default()), config.listens());
        let shared = state.clone();
        // Zenoh has no call that ends an attempt to open a session, so the thread may run until the process exits.
        let opening = thread::Builder::new().name("opening".into()).spawn(move || {
            loop {
                match zenoh::open(config.zenoh()).wait() {
                    Ok(session) => {
                        let _ = shared.session.set(ZenohSession { session, links: Mutex::default() });
                        return;
                    }
                    // A session that listens needs no peer, so another attempt would fail too.
                    Err(error) if listens => {
                        let what = format!("Zenoh does not start: {}", without_locations(&error.to_string()));
                        let failure = Failure::new(Kind::Configuration, what, "see --listen and --config");
                        *shared.failure.lock().unwrap_or_else(PoisonError::into_inner) = Some(failure);
                        return;
                    }
                    Err(_) => thread::sleep(RETRY_INTERVAL),
                }
            }
        });
        opening.map_err(|error| {
            Failure::new(Kind::ResourceExhausted, format!("cannot start a thread: {error}"), "")
        })?;
        Ok(Connection {
            state,
            log,
            listens,
            has_begun: AtomicBool::new(false),
            was_linked: Mutex::new(None),
        })
    }

    /// Lets [`session`](Connection::session) return the session. Called after the bridge has reported that it is ready.
    pub(crate) fn begin(&self) {
        self.has_begun.store(true, Ordering::Relaxed);
    }

    /// Waits for the session and for [`begin`](Connection::begin). Returns `None` if `is_over` is set first.
    pub(crate) fn session(&self, is_over: &AtomicBool) -> Option<&ZenohSession> {
        loop {
            if let Some(session) = self.ready_session() {
                return Some(session);
            }
            if is_over.load(Ordering::Relaxed) {
                return None;
            }
            thread::sleep(POLL_INTERVAL);
        }
    }

    fn ready_session(&self) -> Option<&ZenohSession> {
        self.state.session.get().filter(|_| self.has_begun.load(Ordering::Relaxed))
    }

    /// Returns whether the session is open: it listens, or it is connected to a router.
    pub(crate) fn is_open(&self) -> bool {
        self.state.session.get().is_some()
    }

    /// Returns whether the session listens. A session that listens needs no router.
    pub(crate) fn listens(&self) -> bool {
        self.listens
    }

    /// Returns the reason why the session can never open; `None` while it may still open.
    pub(crate) fn failure(&self) -> Option<Failure> {
        self.state.failure.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Passes each link event that has occurred since the previous call of this function to `report`. The failure of a
    /// session that can never open is not a link event; [`failure`](Connection::failure) returns this failure.
    pub(crate) fn events<E>(&self, mut report: impl FnMut(LinkEvent) -> Result<(), E>) -> Result<(), E> {
        if self.listens && !self.is_open() {
            return Ok(());
        }
        self.log.take().into_iter().try_for_each(|line| report(LinkEvent::Failing(line)))?;
        let mut was_linked = self.was_linked.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(session) = self.ready_session() else { return Ok(()) };
        let is_linked = session.is_linked();
        if was_linked.is_none_or(|before| before != is_linked) && (is_linked || was_linked.is_some()) {
            report(if is_linked { LinkEvent::Up } else { LinkEvent::Down })?;
        }
        *was_linked = Some(is_linked);
        Ok(())
    }

    /// Returns the number of connections that failed or were refused.
    pub(crate) fn refused(&self) -> u64 {
        self.log.count()
    }

    /// Closes the session. A stalled link may delay the close for ten seconds, so this function waits for at most
    /// [`CLOSE_TIMEOUT`]. A session that is not closed by then stays open until the process exits. The peers detect the
    /// exit too.
    pub(crate) fn close(&self) {
        let Some(session) = self.state.session.get().map(|opened| opened.session.clone()) else { return };
        let closing = thread::Builder::new().name("closing".into()).spawn(move || {
            let _ = session.close().wait();
        });
        let end_at = Instant::now() + CLOSE_TIMEOUT;
        while closing.as_ref().is_ok_and(|closing| !closing.is_finished()) && Instant::now() < end_at {
            thread::sleep(POLL_INTERVAL);
        }
    }
}

/// An open session.
pub(crate) struct ZenohSession {
    session: Session,
    links: Mutex<Links>,
}

/// Result of the last check of the links.
#[derive(Clone, Copy, Default)]
struct Links {
    checked: Option<Instant>,
    is_linked: bool,
    /// Whether exactly one program is connected, and this program is a client. A client forwards nothing.
    is_lone_client: bool,
}

/// Time for which a check is valid while there is a connection.
const LINK_CHECK_LIFETIME: Duration = Duration::from_millis(10);

/// A key under which samples are sent. Zenoh's own publisher is not used, because it loses the first sample while it
/// searches for subscribers.
pub(crate) struct Publisher {
    key_expr: KeyExpr<'static>,
}

/// Token that announces that its key exists, until it is dropped.
pub(crate) struct DeclaredToken {
    _token: LivelinessToken,
}

/// Subscription that ends when it is dropped.
pub(crate) struct Subscriber {
    _subscriber: zenoh::pubsub::Subscriber<()>,
}

/// Queryable that replies to queries until it is dropped.
pub(crate) struct Queryable {
    _queryable: zenoh::query::Queryable<()>,
}

/// A reply to a query.
pub(crate) struct Reply {
    pub(crate) key: String,
    pub(crate) payload: Vec<u8>,
    pub(crate) attachment: Option<Vec<u8>>,
}

impl ZenohSession {
    /// Returns whether the session has a link, to a router or from another program.
    pub(crate) fn is_linked(&self) -> bool {
        self.links().is_linked
    }

    fn links(&self) -> Links {
        let mut links = self.links.lock().unwrap_or_else(PoisonError::into_inner);
        let now = Instant::now();
        let is_valid = |checked| now.saturating_duration_since(checked) < LINK_CHECK_LIFETIME;
        if !links.is_linked || !links.checked.is_some_and(is_valid) {
            let mut transports = self.session.info().transports().wait();
            let first = transports.next();
            let is_lone = transports.next().is_none();
            *links = Links {
                checked: Some(now),
                is_linked: first.is_some(),
                is_lone_client: is_lone && first.is_some_and(|peer| peer.whatami() == WhatAmI::Client),
            };
        }
        *links
    }

    /// Returns the session's ID in hexadecimal digits, as Zenoh prints it.
    pub(crate) fn id(&self) -> String {
        self.session.zid().to_string()
    }

    /// Declares `key`, so that [`put`](ZenohSession::put) can send under it.
    pub(crate) fn publisher(&self, key: &str) -> Result<Publisher, Failure> {
        let key_expr = self.session.declare_keyexpr(key.to_owned()).wait();
        Ok(Publisher { key_expr: key_expr.map_err(|error| failed(key, &error))? })
    }

    /// Sends `payload`, and waits until the links have room for it. Returns false if the session was closed.
    ///
    /// The wait ends when the link breaks. It also ends after 5 s if only one client is connected, after 10 s if this
    /// session is the client of a router, and after 1 s if there are several links. Zenoh's configuration file may have
    /// other values. After the wait, the payload is lost on the link that had no room.
    pub(crate) fn put(&self, to: &Publisher, payload: &[u8], attachment: Option<&[u8]>) -> bool {
        // A router would apply `Block` to its own links too. Then one slow subscriber of the router would delay all
        // other subscribers.
        let congestion_control = match self.links().is_lone_client {
            true => CongestionControl::Block,
            false => CongestionControl::Drop,
        };
        let put = self.session.put(&to.key_expr, payload).attachment(attachment);
        let put = put.congestion_control(congestion_control).allowed_destination(Locality::Remote).wait();
        put.is_ok() && !self.session.is_closed()
    }

    /// Declares a token that announces that `key` exists.
    pub(crate) fn token(&self, key: &str) -> Result<DeclaredToken, Failure> {
        let token = self.session.liveliness().declare_token(key.to_owned()).wait();
        token.map(|_token| DeclaredToken { _token }).map_err(|error| failed(key, &error))
    }

    /// Subscribes to `keys`, and passes key and payload of each sample from other sessions to `receive`. The payload is
    /// `None` if it has more than `max_len` bytes, or if the sample only deletes its key.
    pub(crate) fn subscribe(
        &self,
        keys: &str,
        max_len: usize,
        receive: impl Fn(&str, Option<Vec<u8>>) + Send + Sync + 'static,
    ) -> Result<Subscriber, Failure> {
        let subscriber = self.session.declare_subscriber(keys.to_owned()).allowed_origin(Locality::Remote);
        let subscriber = subscriber.callback(move |sample: Sample| pass(&sample, max_len, &receive)).wait();
        subscriber.map(|_subscriber| Subscriber { _subscriber }).map_err(|error| failed(keys, &error))
    }

    /// Passes the key of each token in `keys` to `receive`, both for existing and for new tokens.
    pub(crate) fn watch(
        &self,
        keys: &str,
        receive: impl Fn(&str) + Send + Sync + 'static,
    ) -> Result<Subscriber, Failure> {
        let subscriber = self.session.liveliness().declare_subscriber(keys.to_owned()).history(true);
        let subscriber = subscriber.callback(move |sample: Sample| {
            if sample.kind() == SampleKind::Put {
                receive(sample.key_expr().as_str());
            }
        });
        let subscriber = subscriber.wait();
        subscriber.map(|_subscriber| Subscriber { _subscriber }).map_err(|error| failed(keys, &error))
    }

    /// Replies to queries whose key expression intersects `keys`. `answer` returns the replies. The argument of
    /// `answer` is a function that checks whether a key matches the query. A query may have wildcards.
    pub(crate) fn answer(
        &self,
        keys: &str,
        answer: impl Fn(&dyn Fn(&str) -> bool) -> Vec<Reply> + Send + Sync + 'static,
    ) -> Result<Queryable, Failure> {
        let queryable = self.session.declare_queryable(keys.to_owned()).callback(move |query: Query| {
            let is_queried =
                |key: &str| KeyExpr::try_from(key).is_ok_and(|key| query.key_expr().intersects(&key));
            for Reply { key, payload, attachment } in answer(&is_queried) {
                // Ignore an error: the client may have exited, or may accept only replies under the key of its query.
                let _ = query.reply(key, payload).attachment(attachment).wait();
            }
        });
        let queryable = queryable.wait();
        queryable.map(|_queryable| Queryable { _queryable }).map_err(|error| failed(keys, &error))
    }

    /// Queries `key`, and passes the replies to `receive` as [`subscribe`](ZenohSession::subscribe) does.
    pub(crate) fn query(
        &self,
        key: &str,
        max_len: usize,
        receive: impl Fn(&str, Option<Vec<u8>>) + Send + Sync + 'static,
    ) -> Result<(), Failure> {
        let key_expr = KeyExpr::try_from(key.to_owned()).map_err(|error| failed(key, &error))?;
        let query = self
            .session
            .get(key_expr)
            .target(QueryTarget::All)
            .consolidation(QueryConsolidation::DEFAULT)
            .allowed_destination(Locality::Remote)
            .timeout(QUERY_TIMEOUT)
            .callback(move |reply| {
                if let Ok(sample) = reply.result() {
                    pass(sample, max_len, &receive);
                }
            })
            .wait();
        query.map_err(|error| failed(key, &error))
    }
}

/// Time limit for the replies to a query.
const QUERY_TIMEOUT: Duration = Duration::from_secs(2);

fn pass(sample: &Sample, max_len: usize, receive: &impl Fn(&str, Option<Vec<u8>>)) {
    let is_put = sample.kind() == SampleKind::Put && sample.payload().len() <= max_len;
    receive(sample.key_expr().as_str(), is_put.then(|| sample.payload().to_bytes().into_owned()));
}

fn failed(key: &str, error: &dyn std::fmt::Display) -> Failure {
    Failure::new(Kind::Failed, format!("Zenoh refuses {key}: {}", without_locations(&error.to_string())), "")
}
