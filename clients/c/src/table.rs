//! The handles of a thread. What C has in its hands is a number from here that looks like an address: whatever it brings
//! back is looked up, never followed.

use std::cell::RefCell;
use std::ptr;
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::handle::Handle;
use crate::refusal::Refusal;

/// `struct scanhub_attachment` of the header: there is none.
#[repr(C)]
pub struct Opaque {
    _nothing: [u8; 0],
}

thread_local! {
    // In boxes, because what a handle lends stays where it is when others come.
    #[allow(clippy::vec_box)]
    static HANDLES: RefCell<Vec<(usize, Box<Handle>)>> = const { RefCell::new(Vec::new()) };
}

/// No number is given twice in a process.
static NEXT: AtomicUsize = AtomicUsize::new(1);

/// Keeps `handle` for this thread; what C is to call it.
pub(crate) fn insert(handle: Handle) -> Result<*mut Opaque, Refusal> {
    let number = NEXT.fetch_add(1, Ordering::Relaxed);
    let handle = Box::new(handle);
    let kept = HANDLES.try_with(|handles| handles.borrow_mut().push((number, handle)));
    kept.map(|()| ptr::without_provenance_mut(number)).map_err(|_| UNKNOWN)
}

/// Calls `use_it` with the handle called `name`.
pub(crate) fn with<R>(
    name: *mut Opaque,
    use_it: impl FnOnce(&mut Handle) -> Result<R, Refusal>,
) -> Result<R, Refusal> {
    let found = HANDLES.try_with(|handles| {
        let mut handles = handles.borrow_mut();
        let handle = handles.iter_mut().find(|(number, _)| *number == name.addr());
        use_it(&mut handle.ok_or(UNKNOWN)?.1)
    });
    found.unwrap_or(Err(UNKNOWN))
}

/// Ends the handle called `name`, with all that it holds.
pub(crate) fn remove(name: *mut Opaque) -> Result<(), Refusal> {
    let removed = HANDLES.try_with(|handles| {
        let mut handles = handles.borrow_mut();
        let at = handles.iter().position(|(number, _)| *number == name.addr());
        Ok(handles.swap_remove(at.ok_or(UNKNOWN)?))
    });
    removed.unwrap_or(Err(UNKNOWN)).map(drop)
}

const UNKNOWN: Refusal = Refusal::Argument(
    "this thread has no such handle",
    "a handle is used between scanhub_open and scanhub_close, by the thread that opened it",
);
