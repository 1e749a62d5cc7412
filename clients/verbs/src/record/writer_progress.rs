//! Progress and events that the writing thread passes to the receiving thread. Refuses to know how they are shown.

use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// What the writing thread says to the other one.
#[derive(Default)]
pub(super) struct WriterProgress(Mutex<RecordStats>);

/// How far it came.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct RecordStats {
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

impl WriterProgress {
    /// How far it came; news are told once.
    pub(super) fn look(&self) -> RecordStats {
        let mut stats = self.stats();
        let news = std::mem::take(&mut stats.news);
        RecordStats { news, ..stats.clone() }
    }

    /// For who writes.
    pub(super) fn stats(&self) -> MutexGuard<'_, RecordStats> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
