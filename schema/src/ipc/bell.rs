//! Three words in shared memory on which all consumers of a sensor sleep, one for each ring: one call of the hub wakes all that
//! sleep at a word, however many they are; an event needs one message for each. Refuses to know what was sent, and who
//! sleeps.
//!
//! The page is in /dev/shm under the domain's prefix. Consumers map it read-only. A killed hub leaves it, and the next hub
//! continues with it, so that consumers that sleep meanwhile are woken; a hub that ends normally closes it.
#![allow(unsafe_code)]

mod words;

use std::fs::{File, OpenOptions};
use std::io;
use std::num::NonZeroU32;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

use memmap2::{MmapOptions, MmapRaw};
use rustix::fs::{FallocateFlags, OFlags, fallocate};
use rustix::io::Errno;
use rustix::thread::futex::{self, WaitFlags, WaitPtr, WaitvFlags};
use rustix::time::{ClockId, Timespec};

use super::Node;
use super::strangers::{Segment, in_the_way};
use crate::shortage::{SHARED_MEMORY, memory};
use crate::{Failure, Kind, Ring};

/// The hub's end; dropped it closes the bell and wakes all once more.
#[derive(Debug)]
pub(super) struct Ringer {
    page: Page,
    path: PathBuf,
}

impl Ringer {
    /// The bell of `sensor`: that of a killed hub, which its consumers still have, else a new one.
    ///
    /// [`Kind::Short`] if there is no memory for it, [`Kind::Failed`] if the place is taken by another user.
    pub(super) fn hang(node: &Node, sensor: &str) -> Result<Ringer, Failure> {
        let path = path(node, sensor);
        match Ringer::open(&path) {
            Ok(page) => Ok(Ringer { page, path }),
            Err(Refused::Foreign(segment)) => Err(in_the_way(&segment)),
            Err(Refused::System(error)) if Errno::from_io_error(&error) == Some(Errno::NOSPC) => {
                Err(memory(&format!("no room for {}: {} kB", path.display(), PAGE / 1024)))
            }
            Err(Refused::System(error)) => {
                let what = format!("{}: {error}", path.display());
                Err(Failure::new(Kind::Failed, what, "remove it, or choose another --domain"))
            }
        }
    }

    /// Wakes all who sleep at the word of `ring`.
    pub(super) fn ring(&self, ring: Ring) {
        words::ring(self.page.words().of(ring));
    }

    fn open(path: &Path) -> Result<Page, Refused> {
        loop {
            let mut options = OpenOptions::new();
            let file = own(options.read(true).write(true).create(true).truncate(false), path)?;
            fallocate(&file, FallocateFlags::empty(), 0, PAGE as u64)?;
            let page = Page(MmapOptions::new().len(PAGE).map_raw(&file)?);
            if page.words().closed.load(Ordering::Relaxed) == 0 {
                return Ok(page);
            }
            // Whose hub was killed while it ended: nobody may wait at it any more.
            std::fs::remove_file(path)?;
        }
    }
}

impl Drop for Ringer {
    fn drop(&mut self) {
        // In this order: a hub that is killed in between leaves no page that looks alive and that nobody can find.
        let words = self.page.words();
        words::close(&words.closed, words.of(Ring::First));
        words::ring(words.of(Ring::Last));
        words::ring(words.of(Ring::Early));
        let _ = std::fs::remove_file(&self.path);
    }
}

/// A consumer's end, read-only.
#[derive(Debug)]
pub struct Bell(Page);

impl Bell {
    /// Returns the bell of `sensor`, or nothing as long as no hub has hung it.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if memory or descriptors are, [`Kind::Failed`] if it is another user's.
    pub fn open(node: &Node, sensor: &str) -> Result<Option<Bell>, Failure> {
        let path = path(node, sensor);
        let mapped = own(OpenOptions::new().read(true), &path).and_then(|file| {
            let is_made = file.metadata()?.len() >= PAGE as u64;
            let mapped = is_made.then(|| MmapOptions::new().len(PAGE).map_raw_read_only(&file));
            Ok(mapped.transpose()?.map(|mapped| Bell(Page(mapped))))
        });
        match mapped {
            Ok(bell) => Ok(bell),
            Err(Refused::Foreign(segment)) => Err(in_the_way(&segment)),
            Err(Refused::System(error)) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(Refused::System(error)) => {
                let short = [Errno::MFILE, Errno::NFILE, Errno::NOMEM].map(|errno| errno.raw_os_error());
                let is_short = error.raw_os_error().is_some_and(|errno| short.contains(&errno));
                let kind = if is_short { Kind::Short } else { Kind::Failed };
                let hint = if is_short { "`ulimit -n` may be too small" } else { "is it another user's?" };
                Err(Failure::new(kind, format!("{}: {error}", path.display()), hint))
            }
        }
    }

    /// Returns how often it was rung so, modulo 2^32. What was sent before that can be received after this.
    pub fn rung(&self, ring: Ring) -> u32 {
        words::rung(self.0.words().of(ring))
    }

    /// Returns whether its hub has ended: nobody rings it any more.
    pub fn is_closed(&self) -> bool {
        self.0.words().closed.load(Ordering::Relaxed) != 0
    }
}

/// Why there is no sleeping at bells: the system cannot wait for several words at once (Linux before 5.16, some
/// containers).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Unsupported;

/// Sleeps until one of `bells` was rung, by the ring beside it, more often than the number there says, a signal comes, or
/// CLOCK_MONOTONIC is at `until_ns`.
///
/// # Errors
///
/// [`Unsupported`] if the system cannot wait for several words at once.
pub fn sleep_at_bells(bells: &[(&Bell, Ring, u32)], until_ns: u64) -> Result<(), Unsupported> {
    let until =
        Timespec { tv_sec: (until_ns / 1_000_000_000) as i64, tv_nsec: (until_ns % 1_000_000_000) as i64 };
    let woken = match bells {
        [(bell, ring, rung)] => {
            let word = bell.0.words().of(*ring);
            futex::wait_bitset(word, futex::Flags::empty(), *rung, Some(&until), NonZeroU32::MAX)
        }
        _ => {
            let wait = |(bell, ring, rung): &(&Bell, Ring, u32)| {
                let mut wait = futex::Wait::new();
                wait.val = u64::from(*rung);
                wait.uaddr = WaitPtr::new(bell.0.words().of(*ring).as_ptr().cast());
                wait.flags = WaitFlags::SIZE_U32;
                wait
            };
            let all: Vec<_> = bells.iter().map(wait).collect();
            futex::waitv(&all, WaitvFlags::empty(), Some(&until), ClockId::Monotonic).map(|_| ())
        }
    };
    match woken {
        Ok(()) | Err(Errno::AGAIN | Errno::TIMEDOUT | Errno::INTR) => Ok(()),
        Err(_) => Err(Unsupported),
    }
}

/// What lies in the page, each on a cache line of its own.
#[repr(C)]
struct Words {
    first: AtomicU32,
    _apart: [u32; 15],
    closed: AtomicU32,
    _far: [u32; 15],
    last: AtomicU32,
    _beyond: [u32; 15],
    early: AtomicU32,
}

impl Words {
    fn of(&self, ring: Ring) -> &AtomicU32 {
        match ring {
            Ring::First => &self.first,
            Ring::Last => &self.last,
            Ring::Early => &self.early,
        }
    }
}

/// The page, as long as it is mapped here.
#[derive(Debug)]
struct Page(MmapRaw);

impl Page {
    fn words(&self) -> &Words {
        // SAFETY: the page is mapped as long as it is borrowed, starts at its own border, is longer than the words, and
        // any bytes are words. Nobody shortens the file: it is this user's alone.
        unsafe { &*self.0.as_ptr().cast() }
    }
}

const PAGE: usize = 4096;

fn path(node: &Node, sensor: &str) -> PathBuf {
    Path::new(SHARED_MEMORY).join(format!("{}{sensor}.bell", node.config().global.prefix))
}

/// The file at `path`, if it is this user's alone: anybody may put a file there, or a pipe at which opening it waits. What
/// another user has put there is a failure of another kind than those of the system.
fn own(options: &mut OpenOptions, path: &Path) -> Result<File, Refused> {
    if let Some(segment) = Segment::at(path).filter(Segment::is_foreign) {
        return Err(Refused::Foreign(segment));
    }
    let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK;
    let file = options.mode(0o600).custom_flags(flags.bits() as i32).open(path)?;
    // It may have come in between.
    match Segment::of(path, &file.metadata()?) {
        segment if segment.is_foreign() => Err(Refused::Foreign(segment)),
        _ => Ok(file),
    }
}

/// Why there is no page.
enum Refused {
    System(io::Error),
    Foreign(Segment),
}

impl From<io::Error> for Refused {
    fn from(error: io::Error) -> Refused {
        Refused::System(error)
    }
}

impl From<Errno> for Refused {
    fn from(error: Errno) -> Refused {
        Refused::System(error.into())
    }
}
