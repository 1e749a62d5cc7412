//! The handles of a thread. What C has in its hands is a number from here that looks like an address: whatever it brings
//! back is looked up, never followed. A child after `fork` has what it copied, and never touches it: the parent's samples and
//! its places at the hub are not the child's to give back.

use std::any::Any;
use std::cell::RefCell;
use std::process;
use std::ptr;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use crate::call_error::CallError;

/// `struct scanhub_attachment` and `struct scanhub_publication` of the header: there is none.
#[repr(C)]
pub struct Opaque {
    _nothing: [u8; 0],
}

thread_local! {
    static HANDLES: RefCell<Vec<Entry>> = const { RefCell::new(Vec::new()) };
}

struct Entry {
    number: usize,
    process: u32,
    /// In a box, because what a handle lends stays where it is when others come; nothing only while it ends.
    handle: Option<Box<dyn Any>>,
}

impl Entry {
    fn is_named(&self, name: *mut Opaque) -> bool {
        self.number == name.addr() && self.process == process::id()
    }
}

impl Drop for Entry {
    fn drop(&mut self) {
        let handle = self.handle.take();
        if self.process != process::id() {
            // Still to be found, so that who looks for leaks finds none.
            let mut kept = OF_PARENTS.lock().unwrap_or_else(PoisonError::into_inner);
            kept.extend(handle.map(|handle| Box::into_raw(handle).expose_provenance()));
        }
    }
}

/// Where the handles are that a child has of its parent.
static OF_PARENTS: Mutex<Vec<usize>> = Mutex::new(Vec::new());

/// No number is given twice in a process.
static NEXT: AtomicUsize = AtomicUsize::new(1);

/// Keeps `handle` for this thread; what C is to call it.
pub(crate) fn insert<H: Any>(handle: H) -> Result<*mut Opaque, CallError> {
    let number = NEXT.fetch_add(1, Ordering::Relaxed);
    let entry = Entry { number, process: process::id(), handle: Some(Box::new(handle)) };
    let kept = HANDLES.try_with(|handles| handles.borrow_mut().push(entry));
    kept.map(|()| ptr::without_provenance_mut(number)).map_err(|_| UNKNOWN)
}

/// Calls `use_it` with the handle called `name`, if it is such.
pub(crate) fn with<H: Any, R>(
    name: *mut Opaque,
    use_it: impl FnOnce(&mut H) -> Result<R, CallError>,
) -> Result<R, CallError> {
    let found = HANDLES.try_with(|handles| {
        let mut handles = handles.borrow_mut();
        let entry = handles.iter_mut().find(|entry| entry.is_named(name));
        use_it(entry.and_then(|entry| entry.handle.as_mut()?.downcast_mut()).ok_or(UNKNOWN)?)
    });
    found.unwrap_or(Err(UNKNOWN))
}

/// Ends the handle called `name`, if it is such, with all that it holds.
pub(crate) fn remove<H: Any>(name: *mut Opaque) -> Result<(), CallError> {
    let removed = HANDLES.try_with(|handles| {
        let mut handles = handles.borrow_mut();
        let is_such = |entry: &Entry| entry.handle.as_ref().is_some_and(|handle| handle.is::<H>());
        let at = handles.iter().position(|entry| entry.is_named(name) && is_such(entry));
        Ok(handles.swap_remove(at.ok_or(UNKNOWN)?))
    });
    removed.unwrap_or(Err(UNKNOWN)).map(drop)
}

const UNKNOWN: CallError = CallError::Argument(
    "this thread has no such handle",
    "a handle is used from when it was opened until it is closed, by the thread that opened it; a child opens its own",
);
