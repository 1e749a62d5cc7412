//! Why a call from C did not succeed: a negative number for programs, a message and a remedy for people. Each thread has the
//! last one of its own.

use std::cell::RefCell;
use std::ffi::{CString, c_char, c_int};

use scanhub_schema::{Failure, Kind};

/// A call that did not succeed.
pub(crate) enum CallError {
    /// The caller's fault: what is wrong with an argument, and what would be right.
    Argument(&'static str, &'static str),
    /// What the client library says.
    Failure(Failure),
    /// A panic; its words went to stderr.
    Bug,
}

impl CallError {
    /// The number in the header, `SCANHUB_REFUSED_` .. .
    fn number(&self) -> c_int {
        match self {
            CallError::Argument(..) => -1,
            CallError::Failure(failure) => match failure.kind {
                Kind::Configuration => -2,
                Kind::Short => -3,
                _ => -4,
            },
            CallError::Bug => -5,
        }
    }

    /// Keeps what it says for [`last`], and answers its number.
    pub(crate) fn keep(&self) -> c_int {
        let said = match self {
            CallError::Argument(what, hint) => format!("{what}\n  {hint}"),
            CallError::Failure(failure) => failure.to_string(),
            CallError::Bug => "a bug in this library\n  stderr shows where; please report it".to_owned(),
        };
        // Messages are printable: there is no 0 in them.
        let said = CString::new(said).unwrap_or_default();
        // A thread that is ending keeps nothing.
        let _ = LAST.try_with(|last| last.replace(said));
        self.number()
    }
}

impl From<Failure> for CallError {
    fn from(failure: Failure) -> CallError {
        CallError::Failure(failure)
    }
}

/// What the last refusal of this thread said, until its next one; an empty text if there was none.
pub(crate) fn last() -> *const c_char {
    LAST.try_with(|last| last.borrow().as_ptr()).unwrap_or(c"".as_ptr())
}

thread_local! {
    static LAST: RefCell<CString> = RefCell::default();
}
