//! The doorbell of a sensor: three futex words in shared memory, one for each [`DoorbellWord`], on which subscribers
//! sleep. One system call of the hub wakes all threads that sleep on a word. An event of the library would need one
//! message for each subscriber.
//!
//! The words are in one page of memory, a file in /dev/shm whose name starts with the domain's prefix. Subscribers map
//! the page read-only. A killed hub leaves the page. The next hub continues to use this page, so that it can wake
//! subscribers that still sleep on it. A hub that ends normally closes the page.
//!
//! A fourth word counts how often a program has attached to one of the sensor's services. The hub reads this word
//! instead of the lists of subscribers. iceoryx2 has a list of subscribers for each topic, and each list is in a
//! different page.
//!
//! The operations on words, and their memory orders, must be right in all interleavings of hub and subscribers. The
//! tests run all interleavings.
#![allow(unsafe_code)]

use std::fs::{File, OpenOptions};
use std::io;
use std::num::NonZeroU32;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering, fence};

use iceoryx2::service::Service;
use memmap2::{MmapOptions, MmapRaw};
use rustix::fs::{FallocateFlags, OFlags, fallocate};
use rustix::io::Errno;
use rustix::thread::futex::{self, WaitFlags, WaitPtr, WaitvFlags};
use rustix::time::{ClockId, Timespec};

use scanhub_schema::{DoorbellWord, Failure, Kind};

use crate::processes::Node;
use crate::resource_limits::{SHARED_MEMORY_DIRECTORY, memory_failure};
use crate::segments::{Segment, name_conflict};

/// The hub's end of a doorbell. When it is dropped, it closes the doorbell and wakes all subscribers once more.
#[derive(Debug)]
pub(crate) struct DoorbellRinger {
    mapping: PageMapping,
    path: PathBuf,
}

impl DoorbellRinger {
    /// Opens the doorbell of `sensor` that a killed hub has left, because subscribers may still have it mapped. Creates
    /// a new doorbell if there is none.
    ///
    /// Returns [`Kind::ResourceExhausted`] if there is no memory for the page, and [`Kind::OtherUser`] if a file of
    /// another user has the doorbell's name.
    pub(crate) fn open_or_create<S: Service>(
        node: &Node<S>,
        sensor: &str,
    ) -> Result<DoorbellRinger, Failure> {
        let path = path(node, sensor);
        match DoorbellRinger::open(&path) {
            Ok(page) => Ok(DoorbellRinger { mapping: page, path }),
            Err(OpenError::Foreign(segment)) => Err(name_conflict(&segment)),
            Err(OpenError::System(error)) if Errno::from_io_error(&error) == Some(Errno::NOSPC) => {
                Err(memory_failure(&format!("no room for {}: {} kB", path.display(), PAGE_LEN / 1024)))
            }
            Err(OpenError::System(error)) => {
                let what = format!("{}: {error}", path.display());
                Err(Failure::new(Kind::Failed, what, "remove it, or choose another --domain"))
            }
        }
    }

    /// Wakes all subscribers that sleep at `word`.
    pub(crate) fn ring(&self, word: DoorbellWord) {
        ring(self.mapping.page().word(word));
    }

    /// Returns how often a program has attached to a service of the sensor, modulo 2^32. All subscribers and listeners
    /// that were counted are then visible in the services.
    pub(crate) fn attached(&self) -> u32 {
        read_count(&self.mapping.page().attached)
    }

    fn open(path: &Path) -> Result<PageMapping, OpenError> {
        loop {
            let mut options = OpenOptions::new();
            let file = open_own(options.read(true).write(true).create(true).truncate(false), path)?;
            fallocate(&file, FallocateFlags::empty(), 0, PAGE_LEN as u64)?;
            let page = PageMapping(MmapOptions::new().len(PAGE_LEN).map_raw(&file)?);
            if page.page().closed.load(Ordering::Relaxed) == 0 {
                return Ok(page);
            }
            // The page is closed, so its hub was killed while it was ending. Subscribers leave a closed page, so create
            // a new one.
            std::fs::remove_file(path)?;
        }
    }
}

impl Drop for DoorbellRinger {
    fn drop(&mut self) {
        // Close the page before removing its name. If the hub was killed after removing the name of an open page,
        // subscribers would sleep on a page that the next hub cannot find.
        let words = self.mapping.page();
        close(&words.closed, words.word(DoorbellWord::First));
        ring(words.word(DoorbellWord::Last));
        ring(words.word(DoorbellWord::Early));
        let _ = std::fs::remove_file(&self.path);
    }
}

/// Counts at the doorbell of `sensor` that this process has attached to one of the sensor's services, so that the hub
/// sends this process the next sample. If the doorbell does not exist or cannot be written, the hub finds the
/// subscriber when the hub starts, or after a tenth of a second.
pub(crate) fn count_attached<S: Service>(node: &Node<S>, sensor: &str) {
    let path = path(node, sensor);
    if let Ok(file) = open_own(OpenOptions::new().read(true).write(true), &path)
        && file.metadata().is_ok_and(|metadata| metadata.len() >= PAGE_LEN as u64)
        && let Ok(page) = MmapOptions::new().len(PAGE_LEN).map_raw(&file)
    {
        increment(&PageMapping(page).page().attached);
    }
}

/// A subscriber's end of a doorbell, mapped read-only.
#[derive(Debug)]
pub struct Doorbell(PageMapping);

impl Doorbell {
    /// Returns the doorbell of `sensor`, or `None` if no hub has created it yet.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if memory or descriptors are short, and [`Kind::OtherUser`] if the file
    /// belongs to another user.
    pub fn open<S: Service>(node: &Node<S>, sensor: &str) -> Result<Option<Doorbell>, Failure> {
        let path = path(node, sensor);
        let mapped = open_own(OpenOptions::new().read(true), &path).and_then(|file| {
            let is_complete = file.metadata()?.len() >= PAGE_LEN as u64;
            let mapped = is_complete.then(|| MmapOptions::new().len(PAGE_LEN).map_raw_read_only(&file));
            Ok(mapped.transpose()?.map(|mapped| Doorbell(PageMapping(mapped))))
        });
        match mapped {
            Ok(doorbell) => Ok(doorbell),
            Err(OpenError::Foreign(segment)) => Err(name_conflict(&segment)),
            Err(OpenError::System(error)) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(OpenError::System(error)) => {
                let shortages = [Errno::MFILE, Errno::NFILE, Errno::NOMEM].map(|errno| errno.raw_os_error());
                let is_short = error.raw_os_error().is_some_and(|errno| shortages.contains(&errno));
                let kind = if is_short { Kind::ResourceExhausted } else { Kind::Failed };
                let hint = if is_short { "`ulimit -n` may be too small" } else { "is it another user's?" };
                Err(Failure::new(kind, format!("{}: {error}", path.display()), hint))
            }
        }
    }

    /// Returns the number of times that the hub has rung `word`, modulo 2^32. A subscriber that receives after this
    /// call gets every sample that was sent before these rings.
    pub fn ring_count(&self, word: DoorbellWord) -> u32 {
        read_count(self.0.page().word(word))
    }

    /// Returns whether the hub of this doorbell has ended and does not ring any more.
    pub fn is_closed(&self) -> bool {
        self.0.page().closed.load(Ordering::Relaxed) != 0
    }
}

/// Error of a system that cannot wait for several words at once (Linux before 5.16, some containers).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WaitUnsupported;

/// Sleeps until one of `doorbells` has rung more often than its given count, a signal arrives, or CLOCK_MONOTONIC
/// reaches `until_ns`.
///
/// # Errors
///
/// Returns [`WaitUnsupported`] if the system cannot wait for several words at once.
pub fn wait_on_doorbells(
    doorbells: &[(&Doorbell, DoorbellWord, u32)],
    until_ns: u64,
) -> Result<(), WaitUnsupported> {
    let until =
        Timespec { tv_sec: (until_ns / 1_000_000_000) as i64, tv_nsec: (until_ns % 1_000_000_000) as i64 };
    let woken = match doorbells {
        [(bell, ring, count)] => {
            let word = bell.0.page().word(*ring);
            futex::wait_bitset(word, futex::Flags::empty(), *count, Some(&until), NonZeroU32::MAX)
        }
        _ => {
            let wait = |(bell, ring, count): &(&Doorbell, DoorbellWord, u32)| {
                let mut wait = futex::Wait::new();
                wait.val = u64::from(*count);
                wait.uaddr = WaitPtr::new(bell.0.page().word(*ring).as_ptr().cast());
                wait.flags = WaitFlags::SIZE_U32;
                wait
            };
            let all: Vec<_> = doorbells.iter().map(wait).collect();
            futex::waitv(&all, WaitvFlags::empty(), Some(&until), ClockId::Monotonic).map(|_| ())
        }
    };
    match woken {
        Ok(()) | Err(Errno::AGAIN | Errno::TIMEDOUT | Errno::INTR) => Ok(()),
        Err(_) => Err(WaitUnsupported),
    }
}

/// Words of the page, each on a separate cache line. Only `attached` shares the cache line of `first`, because the hub
/// uses both words for each telegram, and `attached` seldom changes.
#[repr(C)]
struct DoorbellPage {
    first: AtomicU32,
    attached: AtomicU32,
    _padding: [u32; 14],
    closed: AtomicU32,
    _padding2: [u32; 15],
    last: AtomicU32,
    _padding3: [u32; 15],
    early: AtomicU32,
}

impl DoorbellPage {
    fn word(&self, word: DoorbellWord) -> &AtomicU32 {
        match word {
            DoorbellWord::First => &self.first,
            DoorbellWord::Last => &self.last,
            DoorbellWord::Early => &self.early,
        }
    }
}

/// The mapped page. Dropping this value unmaps it.
#[derive(Debug)]
struct PageMapping(MmapRaw);

impl PageMapping {
    fn page(&self) -> &DoorbellPage {
        // SAFETY: the page is mapped while it is borrowed, starts at a page boundary, is longer than the words, and any
        // bytes are valid words. The file belongs to this user alone, and no process truncates it.
        unsafe { &*self.0.as_ptr().cast() }
    }
}

const PAGE_LEN: usize = 4096;

fn path<S: Service>(node: &Node<S>, sensor: &str) -> PathBuf {
    Path::new(SHARED_MEMORY_DIRECTORY).join(format!("{}{sensor}.bell", node.config().global.prefix))
}

/// Opens the file at `path` if it belongs to this user alone. Any user can create a file at this path, or a pipe.
/// NONBLOCK is set because opening a pipe would block.
fn open_own(options: &mut OpenOptions, path: &Path) -> Result<File, OpenError> {
    if let Some(segment) = Segment::at(path).filter(Segment::is_foreign) {
        return Err(OpenError::Foreign(segment));
    }
    let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK;
    let file = options.mode(0o600).custom_flags(flags.bits() as i32).open(path)?;
    // Another user may have created the file after the first check.
    match Segment::of(path, &file.metadata()?) {
        segment if segment.is_foreign() => Err(OpenError::Foreign(segment)),
        _ => Ok(file),
    }
}

/// Reason why the page cannot be used.
enum OpenError {
    System(io::Error),
    Foreign(Segment),
}

impl From<io::Error> for OpenError {
    fn from(error: io::Error) -> OpenError {
        OpenError::System(error)
    }
}

impl From<Errno> for OpenError {
    fn from(error: Errno) -> OpenError {
        OpenError::System(error.into())
    }
}

/// A word in shared memory at which threads of several processes can sleep.
trait FutexWord {
    fn fetch_add(&self, summand: u32, order: Ordering) -> u32;
    fn load(&self, order: Ordering) -> u32;
    fn store(&self, value: u32, order: Ordering);
    fn fence(order: Ordering);
    /// Wakes all threads that sleep at this word.
    fn wake(&self);
}

/// Increments the `counter` of rings and wakes all threads that sleep on it. A thread that sees the new count also sees
/// all samples that were sent before.
fn ring(counter: &impl FutexWord) {
    counter.fetch_add(1, Ordering::Release);
    counter.wake();
}

/// Increments the `counter` of attached programs. A hub that sees the new count also sees the programs that attached
/// before.
fn increment(counter: &impl FutexWord) {
    counter.fetch_add(1, Ordering::Release);
}

/// Returns the `counter` of rings. All samples that were sent before the last increment can be received after this
/// call.
fn read_count<W: FutexWord>(counter: &W) -> u32 {
    // Only a relaxed load may touch memory that is mapped read-only.
    let count = counter.load(Ordering::Relaxed);
    W::fence(Ordering::Acquire);
    count
}

/// Sets the word `closed` and wakes all threads once more. A thread that sees the new count also sees that the doorbell
/// is closed.
fn close<W: FutexWord>(closed: &W, counter: &W) {
    closed.store(1, Ordering::Relaxed);
    ring(counter);
}

impl FutexWord for AtomicU32 {
    fn fetch_add(&self, summand: u32, order: Ordering) -> u32 {
        self.fetch_add(summand, order)
    }

    fn load(&self, order: Ordering) -> u32 {
        self.load(order)
    }

    fn store(&self, value: u32, order: Ordering) {
        self.store(value, order);
    }

    fn fence(order: Ordering) {
        fence(order);
    }

    fn wake(&self) {
        // It is not an error if no thread sleeps, and no other error is possible for a mapped word.
        let _ = futex::wake(self, futex::Flags::empty(), i32::MAX as u32);
    }
}

#[cfg(test)]
mod tests;
