//! Zenoh, and nothing of scanhub: a session that is opened beside the work, its publishers, tokens, subscribers and answers,
//! and what it says of its links. Refuses to know what is in a payload.

mod attached;
mod certificate;
mod config;
mod log;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use schema::{Failure, Kind};
use zenoh::key_expr::KeyExpr;
use zenoh::liveliness::LivelinessToken;
use zenoh::qos::CongestionControl;
use zenoh::query::{Query, QueryConsolidation, QueryTarget, Queryable};
use zenoh::sample::{Locality, Sample, SampleKind};
use zenoh::session::SessionPutBuilder;
use zenoh::{Session, Wait};

pub(crate) use config::Prepared;
use log::{Log, without_places};

/// A session that is there as soon as it can be.
pub(crate) struct Connection {
    state: Arc<State>,
    log: Log,
    /// It listens: then there soon is a session, or never.
    listens: bool,
    /// It was told that there is a session: nothing that comes over it is told before.
    has_begun: AtomicBool,
    is_up: Mutex<Option<bool>>,
}

#[derive(Default)]
struct State {
    engine: OnceLock<Engine>,
    failure: Mutex<Option<Failure>>,
}

/// What is new of the links.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum News {
    /// Somebody is connected.
    Up,
    /// Nobody is connected any more.
    Down,
    /// Something does not succeed, in Zenoh's words.
    Failing(String),
}

/// Between two attempts to open a session.
const AGAIN: Duration = Duration::from_millis(300);
/// Between two looks at what is not yet there.
const LOOK_EVERY: Duration = Duration::from_millis(5);

impl Connection {
    /// Begins to open what was `prepared`, and goes on until it succeeds.
    pub(crate) fn open(prepared: Prepared) -> Result<Connection, Failure> {
        let log = Log::install();
        let (state, listens) = (Arc::new(State::default()), prepared.listens());
        let theirs = state.clone();
        // It ends with the process: an attempt cannot be ended.
        let opening = thread::Builder::new().name("opening".into()).spawn(move || {
            loop {
                match zenoh::open(prepared.config()).wait() {
                    Ok(session) => {
                        let _ =
                            theirs.engine.set(Engine { session, seen: Mutex::new((Instant::now(), false)) });
                        return;
                    }
                    // Who listens waits for nobody: it cannot be.
                    Err(error) if listens => {
                        let what = format!("Zenoh does not start: {}", without_places(&error.to_string()));
                        let failure = Failure::new(Kind::Configuration, what, "see --listen and --config");
                        *theirs.failure.lock().unwrap_or_else(PoisonError::into_inner) = Some(failure);
                        return;
                    }
                    Err(_) => thread::sleep(AGAIN),
                }
            }
        });
        opening.map_err(|error| Failure::new(Kind::Short, format!("cannot start a thread: {error}"), ""))?;
        Ok(Connection { state, log, listens, has_begun: AtomicBool::new(false), is_up: Mutex::new(None) })
    }

    /// Lets [`engine`](Connection::engine) have the session: that it is there was told.
    pub(crate) fn begin(&self) {
        self.has_begun.store(true, Ordering::Relaxed);
    }

    /// Waits for the session and for [`begin`](Connection::begin); nothing if it `is_over` before.
    pub(crate) fn engine(&self, is_over: &AtomicBool) -> Option<&Engine> {
        loop {
            if let Some(engine) = self.begun() {
                return Some(engine);
            }
            if is_over.load(Ordering::Relaxed) {
                return None;
            }
            thread::sleep(LOOK_EVERY);
        }
    }

    fn begun(&self) -> Option<&Engine> {
        self.state.engine.get().filter(|_| self.has_begun.load(Ordering::Relaxed))
    }

    /// Whether there is a session: it listens, or who only connects is connected.
    pub(crate) fn is_open(&self) -> bool {
        self.state.engine.get().is_some()
    }

    /// Whether it is others that connect: it waits for no router.
    pub(crate) fn listens(&self) -> bool {
        self.listens
    }

    /// Why there never will be a session, if that is known.
    pub(crate) fn failure(&self) -> Option<Failure> {
        self.state.failure.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Tells what is new. Why there never will be a session, [`failure`](Connection::failure) says.
    pub(crate) fn news<E>(&self, mut tell: impl FnMut(News) -> Result<(), E>) -> Result<(), E> {
        if self.listens && !self.is_open() {
            return Ok(());
        }
        self.log.take().into_iter().try_for_each(|line| tell(News::Failing(line)))?;
        let mut is_up = self.is_up.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(engine) = self.begun() else { return Ok(()) };
        let is_linked = engine.is_linked();
        if is_up.is_none_or(|before| before != is_linked) && (is_linked || is_up.is_some()) {
            tell(if is_linked { News::Up } else { News::Down })?;
        }
        *is_up = Some(is_linked);
        Ok(())
    }

    /// Connections that did not come about or were refused.
    pub(crate) fn refused(&self) -> u64 {
        self.log.count()
    }

    /// Takes leave of everybody.
    pub(crate) fn close(&self) {
        if let Some(engine) = self.state.engine.get() {
            // Who does not hear it sees it by the silence.
            let _ = engine.session.close().wait();
        }
    }
}

/// A session.
pub(crate) struct Engine {
    session: Session,
    /// When it was last looked whether somebody is connected, and whether one was.
    seen: Mutex<(Instant, bool)>,
}

/// So long an answer to whether somebody is connected is good.
const LINK_STANDS: Duration = Duration::from_millis(10);

/// What sends under one name. It is no publisher of Zenoh's: of those the first sample is lost while they ask who wants it.
pub(crate) struct Publisher {
    session: Session,
    key_expr: KeyExpr<'static>,
}

/// Says that something is there as long as this is.
pub(crate) struct Token {
    _token: LivelinessToken,
}

/// Hears as long as it is there.
pub(crate) struct Ear {
    _subscriber: zenoh::pubsub::Subscriber<()>,
}

/// Answers as long as it is there.
pub(crate) struct Answers {
    _queryable: Queryable<()>,
}

impl Engine {
    /// Whether anybody is connected: a router, or who connected to this one.
    pub(crate) fn is_linked(&self) -> bool {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        let now = Instant::now();
        if !seen.1 || now.saturating_duration_since(seen.0) >= LINK_STANDS {
            let is_linked = self.session.info().transports().wait().next().is_some();
            *seen = (now, is_linked);
        }
        seen.1
    }

    /// What sends under `key`, without waiting for more to send at once. What a link has no room for is waited for, as long
    /// as the configuration says; a router on the way drops what it has no room for.
    pub(crate) fn publisher(&self, key: &str) -> Result<Publisher, Failure> {
        let key_expr = self.session.declare_keyexpr(key.to_owned()).wait();
        let key_expr = key_expr.map_err(|error| failed(key, &error))?;
        Ok(Publisher { session: self.session.clone(), key_expr })
    }

    /// Says to everybody that `key` is there.
    pub(crate) fn token(&self, key: &str) -> Result<Token, Failure> {
        let token = self.session.liveliness().declare_token(key.to_owned()).wait();
        token.map(|_token| Token { _token }).map_err(|error| failed(key, &error))
    }

    /// Hands the key and the payload of what others send under `keys` to `hear`; the payload is whole or nothing, if it is
    /// longer than `longest`.
    pub(crate) fn subscribe(
        &self,
        keys: &str,
        longest: usize,
        hear: impl Fn(&str, Option<Vec<u8>>) + Send + Sync + 'static,
    ) -> Result<Ear, Failure> {
        let heard = self.session.declare_subscriber(keys.to_owned()).allowed_origin(Locality::Remote);
        let heard = heard.callback(move |sample: Sample| hand(&sample, longest, &hear)).wait();
        heard.map(|_subscriber| Ear { _subscriber }).map_err(|error| failed(keys, &error))
    }

    /// Hands `hear` the name of each token of `keys` that is there or comes.
    pub(crate) fn watch(
        &self,
        keys: &str,
        hear: impl Fn(&str) + Send + Sync + 'static,
    ) -> Result<Ear, Failure> {
        let heard = self.session.liveliness().declare_subscriber(keys.to_owned()).history(true);
        let heard = heard.callback(move |sample: Sample| {
            if sample.kind() == SampleKind::Put {
                hear(sample.key_expr().as_str());
            }
        });
        let heard = heard.wait();
        heard.map(|_subscriber| Ear { _subscriber }).map_err(|error| failed(keys, &error))
    }

    /// Answers who asks for one of `keys` with what `answer` has of it.
    pub(crate) fn answer(
        &self,
        keys: &str,
        answer: impl Fn(&str) -> Option<Vec<u8>> + Send + Sync + 'static,
    ) -> Result<Answers, Failure> {
        let answers = self.session.declare_queryable(keys.to_owned()).callback(move |query: Query| {
            let key = query.key_expr().clone();
            if let Some(payload) = answer(key.as_str()) {
                // Who asked may be gone.
                let _ = query.reply(key, payload).wait();
            }
        });
        let answers = answers.wait();
        answers.map(|_queryable| Answers { _queryable }).map_err(|error| failed(keys, &error))
    }

    /// Asks for `key`; answers go to `hear` as those of [`subscribe`](Engine::subscribe).
    pub(crate) fn ask(
        &self,
        key: &str,
        longest: usize,
        hear: impl Fn(&str, Option<Vec<u8>>) + Send + Sync + 'static,
    ) -> Result<(), Failure> {
        let key_expr = KeyExpr::try_from(key.to_owned()).map_err(|error| failed(key, &error))?;
        let asked = self
            .session
            .get(key_expr)
            .target(QueryTarget::All)
            .consolidation(QueryConsolidation::DEFAULT)
            .allowed_destination(Locality::Remote)
            .timeout(ANSWER_WITHIN)
            .callback(move |reply| {
                if let Ok(sample) = reply.result() {
                    hand(sample, longest, &hear);
                }
            })
            .wait();
        asked.map_err(|error| failed(key, &error))
    }
}

/// So long an answer may take.
const ANSWER_WITHIN: Duration = Duration::from_secs(2);

fn hand(sample: &Sample, longest: usize, hear: &impl Fn(&str, Option<Vec<u8>>)) {
    let is_put = sample.kind() == SampleKind::Put && sample.payload().len() <= longest;
    hear(sample.key_expr().as_str(), is_put.then(|| sample.payload().to_bytes().into_owned()));
}

impl Publisher {
    /// Sends `bytes`; whether Zenoh took them.
    pub(crate) fn put(&self, bytes: &[u8]) -> bool {
        self.putting(bytes).wait().is_ok()
    }

    fn putting<'a>(&'a self, bytes: &[u8]) -> SessionPutBuilder<'a, 'a> {
        let put = self.session.put(&self.key_expr, bytes);
        put.congestion_control(CongestionControl::Drop).express(true).allowed_destination(Locality::Remote)
    }
}

fn failed(key: &str, error: &dyn std::fmt::Display) -> Failure {
    Failure::new(Kind::Failed, format!("Zenoh refuses {key}: {}", without_places(&error.to_string())), "")
}
