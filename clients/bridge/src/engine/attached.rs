//! Messages that others' conventions want something with: bytes beside the payload, and the last of them for who comes late.
//! Refuses to know which conventions.

use schema::Failure;
use zenoh::Wait;
use zenoh::query::Query;

use super::{Answers, Engine, Publisher, failed};

impl Publisher {
    /// Sends `bytes` with an `attachment`; whether Zenoh took them.
    pub(crate) fn put_with(&self, bytes: &[u8], attachment: &[u8]) -> bool {
        self.putting(bytes).attachment(attachment).wait().is_ok()
    }
}

impl Engine {
    /// The session's identity, as Zenoh writes it in hexadecimal digits.
    pub(crate) fn identity(&self) -> String {
        self.session.zid().to_string()
    }

    /// Answers who asks for `history` with the payload and the attachment that `answer` has, as if they came now under
    /// `key`.
    pub(crate) fn answer_as(
        &self,
        history: &str,
        key: String,
        answer: impl Fn() -> Option<(Vec<u8>, Vec<u8>)> + Send + Sync + 'static,
    ) -> Result<Answers, Failure> {
        let answers = self.session.declare_queryable(history.to_owned()).callback(move |query: Query| {
            if let Some((payload, attachment)) = answer() {
                // Who asked may be gone, or take answers under the name that was asked for alone.
                let _ = query.reply(key.as_str(), payload).attachment(attachment).wait();
            }
        });
        let answers = answers.wait();
        answers.map(|_queryable| Answers { _queryable }).map_err(|error| failed(history, &error))
    }
}
