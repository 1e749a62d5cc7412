//! What the writing thread says to the one that receives: how far it came, and what happened. Refuses to know how it is told.

use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// What the writing thread says to the other one.
#[derive(Default)]
pub(super) struct Told(Mutex<Account>);

/// How far it came.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Account {
    /// Bytes in all files, as far as these are still there.
    pub(super) bytes: u64,
    /// Samples in all files, as far as these are still there.
    pub(super) samples: u64,
    /// What happened since it was looked at last.
    pub(super) news: Vec<News>,
}

/// What is worth a word.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum News {
    /// It goes on in this file.
    File(PathBuf),
    /// What comes cannot be written, and why.
    Trouble(PathBuf, String),
    /// It can be written again, after this time.
    Well(PathBuf, Duration),
    /// So many samples that were written are in no file any more: this one was removed, or cut.
    Gone(PathBuf, u64),
    /// Nobody reads what is written any more.
    ReaderGone,
}

impl Told {
    /// How far it came; news are told once.
    pub(super) fn look(&self) -> Account {
        let mut account = self.account();
        let news = std::mem::take(&mut account.news);
        Account { news, ..account.clone() }
    }

    /// For who writes.
    pub(super) fn account(&self) -> MutexGuard<'_, Account> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
