//! Addresses that come from C, made into what Rust may look at, and the sample that C sees. The only file here with unsafe
//! code; refuses to know what the calls do.
#![allow(unsafe_code)]

use std::ffi::{CStr, c_char, c_int, c_void};
use std::mem::MaybeUninit;
use std::ptr;

use scanhub_schema::Header;

use crate::call_error::CallError;
use crate::table::Opaque;

/// `scanhub_sample` of the header.
#[repr(C)]
pub struct Lent {
    /// Numbers, stamps and quality; NULL: nobody sent it.
    pub header: *const Header,
    /// The payload, where it lies.
    pub payload: *const c_void,
    /// Its bytes.
    pub length: usize,
    /// Samples of this topic that were sent before it and not received.
    pub missed: u64,
    /// 1: the hub restarted since the last sample.
    pub restarted: c_int,
    /// 1: zones that are unknown because nothing was heard.
    pub stale: c_int,
    /// Whose it is.
    pub of: *mut Opaque,
    /// Under which number it is lent there.
    pub number: u64,
}

impl Lent {
    /// Nothing is lent.
    pub(crate) fn none() -> Lent {
        Lent {
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

/// The text at `address`; nothing for NULL.
pub(crate) fn text<'a>(address: *const c_char) -> Result<Option<&'a str>, CallError> {
    if address.is_null() {
        return Ok(None);
    }
    // SAFETY: it is not NULL, and the header asks for a text that ends with 0 and stays as it is until the call is over;
    // no caller here keeps it longer.
    let text = unsafe { CStr::from_ptr(address) };
    let not_text = CallError::Argument("a name is not UTF-8", "names are made of a-z, 0-9, _ and -");
    text.to_str().map(Some).map_err(|_| not_text)
}

/// Where an answer goes to; what lies there before may be anything.
pub(crate) fn place<'a, T>(address: *mut T) -> Result<&'a mut MaybeUninit<T>, CallError> {
    check(address)?;
    // SAFETY: it is not NULL and aligned, and the header asks for room for one T that nobody else uses during the call; no
    // caller here keeps it longer.
    unsafe { address.cast::<MaybeUninit<T>>().as_mut() }.ok_or(NULL)
}

/// A sample that was filled by an earlier call.
pub(crate) fn sample<'a>(address: *mut Lent) -> Result<&'a mut Lent, CallError> {
    check(address)?;
    // SAFETY: as in `place`; the header asks for a sample that was taken or zeroed, and no value of a field is impossible.
    unsafe { address.as_mut() }.ok_or(NULL)
}

fn check<T>(address: *mut T) -> Result<(), CallError> {
    if address.is_null() {
        return Err(NULL);
    }
    match address.is_aligned() {
        true => Ok(()),
        false => Err(CallError::Argument("an address is not aligned", "give that of a variable of the type")),
    }
}

const NULL: CallError = CallError::Argument("an argument is NULL", "give the address of a variable");
