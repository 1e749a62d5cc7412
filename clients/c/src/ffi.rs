//! Boundary to C: addresses from C as Rust references, the struct of a sample, and the error of a call. All unsafe code
//! of this crate is in this module.
#![allow(unsafe_code)]

use std::cell::RefCell;
use std::ffi::{CStr, CString, c_char, c_int, c_void};
use std::mem::MaybeUninit;
use std::ptr;

use scanhub_client::{Error, ErrorKind};
use scanhub_schema::Header;

use crate::handle::Opaque;

/// `scanhub_sample` of the header.
#[repr(C)]
pub struct BorrowedSample {
    /// Header of the sample. NULL if no publisher sent it.
    pub header: *const Header,
    /// Payload, in the memory of the topic.
    pub payload: *const c_void,
    /// Number of used bytes of the payload.
    pub length: usize,
    /// Number of samples of this topic that were sent before this one and not received.
    pub missed: u64,
    /// 1 if the hub has restarted since the last sample.
    pub restarted: c_int,
    /// 1 for zones whose verdict is unknown because of a silence.
    pub stale: c_int,
    /// Handle that lent the sample.
    pub of: *mut Opaque,
    /// Number that identifies the loan in that handle.
    pub number: u64,
}

impl BorrowedSample {
    /// Returns an empty sample, which is not lent.
    pub(crate) fn none() -> BorrowedSample {
        BorrowedSample {
            header: ptr::null(),
            payload: ptr::null(),
            length: 0,
            missed: 0,
            restarted: 0,
            stale: 0,
            of: ptr::null_mut(),
            number: 0,
        }
    }
}

/// Returns the text at `address`, or `None` for NULL.
pub(crate) fn text<'a>(address: *const c_char) -> Result<Option<&'a str>, CallError> {
    if address.is_null() {
        return Ok(None);
    }
    // SAFETY: the address is not NULL, and the header requires a text that ends with 0 and does not change during the
    // call. No caller in this crate keeps the text longer.
    let text = unsafe { CStr::from_ptr(address) };
    let not_text = CallError::Argument("a name is not UTF-8", "names consist of a-z, 0-9, _ and -");
    text.to_str().map(Some).map_err(|_| not_text)
}

/// Returns the memory for an output argument. The memory may have any content before the call.
pub(crate) fn output<'a, T>(address: *mut T) -> Result<&'a mut MaybeUninit<T>, CallError> {
    check(address)?;
    // SAFETY: the address is not NULL and is aligned, and the header requires memory for one T that only the library
    // uses during the call. No caller in this crate keeps the reference longer.
    unsafe { address.cast::<MaybeUninit<T>>().as_mut() }.ok_or(NULL_ARGUMENT)
}

/// Returns a sample that an earlier call filled.
pub(crate) fn sample<'a>(address: *mut BorrowedSample) -> Result<&'a mut BorrowedSample, CallError> {
    check(address)?;
    // SAFETY: as in `output`. The header requires a sample that was taken or zeroed, and every value of a field is
    // valid.
    unsafe { address.as_mut() }.ok_or(NULL_ARGUMENT)
}

/// Returns the memory for an optional output argument, or `None` for NULL.
pub(crate) fn optional_output<'a, T>(address: *mut T) -> Result<Option<&'a mut MaybeUninit<T>>, CallError> {
    if address.is_null() { Ok(None) } else { output(address).map(Some) }
}

/// Writes `names` to the `size` bytes at `address`, separated by blanks and followed by a 0. If not all names fit,
/// writes as many of the first ones as fit. Returns the length of the complete text without its 0.
pub(crate) fn write_names(names: &[String], address: *mut c_char, size: usize) -> Result<c_int, CallError> {
    let text = names.join(" ");
    if size > 0 {
        check(address)?;
        let is_end = |end: &usize| *end < size && (*end == text.len() || text.as_bytes()[*end] == b' ');
        let end = (1..=text.len()).rev().find(is_end).unwrap_or(0);
        // SAFETY: the address is not NULL, and the header requires memory for `size` bytes that only the library uses
        // during the call. The code writes `end` + 1 bytes, and `end` is less than `size`.
        unsafe {
            ptr::copy_nonoverlapping(text.as_ptr(), address.cast(), end);
            address.add(end).write(0);
        }
    }
    Ok(c_int::try_from(text.len()).unwrap_or(c_int::MAX))
}

fn check<T>(address: *mut T) -> Result<(), CallError> {
    if address.is_null() {
        return Err(NULL_ARGUMENT);
    }
    match address.is_aligned() {
        true => Ok(()),
        false => Err(CallError::Argument(
            "an address is not aligned",
            "give the address of a variable of the type",
        )),
    }
}

const NULL_ARGUMENT: CallError = CallError::Argument("an argument is NULL", "give the address of a variable");

/// Error of a call from C: a negative number for the program, and a message with a remedy for its user.
pub(crate) enum CallError {
    /// Invalid argument: the message, and the remedy.
    Argument(&'static str, &'static str),
    /// Error of the client library.
    Client(Error),
    /// Panic in this library. The message of the panic is on stderr.
    Bug,
}

impl CallError {
    /// Returns the number of the error in the header, `SCANHUB_REFUSED_..`.
    fn number(&self) -> c_int {
        match self {
            CallError::Argument(..) => -1,
            CallError::Client(error) => match error.kind() {
                ErrorKind::InvalidInput => -2,
                ErrorKind::ResourceExhausted => -3,
                _ => -4,
            },
            CallError::Bug => -5,
        }
    }

    /// Stores the message for [`last_message`], and returns the number of the error.
    pub(crate) fn keep(&self) -> c_int {
        let message = match self {
            CallError::Argument(what, hint) => format!("{what}\n  {hint}"),
            CallError::Client(error) => error.to_string(),
            CallError::Bug => "a bug in this library\n  stderr shows where; please report it".to_owned(),
        };
        // Messages are printable text, so they contain no 0.
        let message = CString::new(message).unwrap_or_default();
        // A thread that is ending cannot store the message.
        let _ = LAST.try_with(|last| last.replace(message));
        self.number()
    }
}

impl From<Error> for CallError {
    fn from(error: Error) -> CallError {
        CallError::Client(error)
    }
}

/// Returns the message of this thread's last error, or an empty text if there was no error. The message is valid until
/// the next error of this thread.
pub(crate) fn last_message() -> *const c_char {
    LAST.try_with(|last| last.borrow().as_ptr()).unwrap_or(c"".as_ptr())
}

thread_local! {
    static LAST: RefCell<CString> = RefCell::default();
}
