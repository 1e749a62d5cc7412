//! The functions of the header, one call each. What they answer is checked there and kept here: no panic gets out, and
//! every refusal leaves its words behind.
#![allow(unsafe_code)] // Names as they are written, for the linker; no block is unsafe here.

use std::ffi::{CStr, c_char, c_int};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Duration;

use scanhub_client::{Wait, places};
use scanhub_schema::{Tilt, Topic};

use crate::boundary::{Lent, place, sample, text};
use crate::call_error::{self, CallError};
use crate::handle::{Handle, Mount};
use crate::table::{self, Opaque};

/// Begins to follow a topic; answers 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_open(
    handle: *mut *mut Opaque,
    domain: *const c_char,
    sensor: *const c_char,
    topic: c_int,
    wait: c_int,
) -> c_int {
    answer(|| {
        let handle = place(handle)?;
        handle.write(std::ptr::null_mut());
        let sensor =
            text(sensor)?.ok_or(CallError::Argument("no sensor is named", "for example \"front\""))?;
        let topic = u8::try_from(topic).ok().and_then(Topic::of_number);
        let topic = topic.ok_or(CallError::Argument("there is no such topic", "one of SCANHUB_TOPIC_.."))?;
        let opened = Handle::open(places(text(domain)?)?, sensor, topic, way(wait)?)?;
        handle.write(table::insert(opened)?);
        Ok(0)
    })
}

/// Begins to follow the verdict of a robot; answers 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_open_robot(
    handle: *mut *mut Opaque,
    domain: *const c_char,
    sensors: *const c_char,
    wait: c_int,
) -> c_int {
    answer(|| open_robot(handle, domain, sensors, wait, false))
}

/// The same, with early warnings; answers 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_open_robot_early(
    handle: *mut *mut Opaque,
    domain: *const c_char,
    sensors: *const c_char,
    wait: c_int,
) -> c_int {
    answer(|| open_robot(handle, domain, sensors, wait, true))
}

fn open_robot(
    handle: *mut *mut Opaque,
    domain: *const c_char,
    sensors: *const c_char,
    wait: c_int,
    early: bool,
) -> Result<c_int, CallError> {
    let handle = place(handle)?;
    handle.write(std::ptr::null_mut());
    let sensors: Vec<&str> = text(sensors)?.unwrap_or_default().split_ascii_whitespace().collect();
    let opened = Handle::open_robot(places(text(domain)?)?, &sensors, way(wait)?, early)?;
    handle.write(table::insert(opened)?);
    Ok(0)
}

/// The descriptor to poll; answers it.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_fd(handle: *mut Opaque) -> c_int {
    answer(|| table::with(handle, Handle::descriptor))
}

/// Waits for a sample; answers 1 if there is one, 0 if the time is over.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_wait(handle: *mut Opaque, timeout_ms: c_int) -> c_int {
    let timeout = u64::try_from(timeout_ms).ok().map(Duration::from_millis);
    answer(|| table::with(handle, |handle: &mut Handle| handle.wait(timeout)).map(c_int::from))
}

/// Lends the next sample; answers 1 if there was one, else 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_take(handle: *mut Opaque, taken: *mut Lent) -> c_int {
    answer(|| {
        let taken = place(taken)?;
        taken.write(Lent::none());
        match table::with(handle, Handle::take)? {
            Some(lent) => {
                taken.write(Lent { of: handle, ..lent });
                Ok(1)
            }
            None => Ok(0),
        }
    })
}

/// Takes a sample back; answers 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_release(taken: *mut Lent) -> c_int {
    answer(|| {
        let taken = sample(taken)?;
        let Lent { of, number, .. } = *taken;
        // Unless it was released before, or never filled. One that is refused stays as it is, for the thread that took it.
        if !of.is_null() {
            table::with(of, |handle: &mut Handle| handle.give_back(number))?;
        }
        *taken = Lent::none();
        Ok(0)
    })
}

/// Ends it all, samples that are still lent too; answers 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_close(handle: *mut Opaque) -> c_int {
    answer(|| if handle.is_null() { Ok(0) } else { table::remove::<Handle>(handle).map(|()| 0) })
}

/// Begins to publish the angles of a mount; answers 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_publish_tilt(
    publication: *mut *mut Opaque,
    domain: *const c_char,
    name: *const c_char,
) -> c_int {
    answer(|| {
        let publication = place(publication)?;
        publication.write(std::ptr::null_mut());
        let name = text(name)?.ok_or(CallError::Argument("no mount is named", "for example \"mount\""))?;
        publication.write(table::insert(Mount::publish(text(domain)?, name)?)?);
        Ok(0)
    })
}

/// Says how the mount stands; answers 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_send_tilt(
    publication: *mut Opaque,
    stamp_ns: u64,
    angle_rad: f64,
    rate_rad_s: f64,
) -> c_int {
    let tilt = Tilt { angle_rad, rate_rad_s };
    answer(|| table::with(publication, |mount: &mut Mount| mount.send(stamp_ns, tilt)).map(|()| 0))
}

/// Ends it and gives the name free; answers 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_unpublish(publication: *mut Opaque) -> c_int {
    answer(|| if publication.is_null() { Ok(0) } else { table::remove::<Mount>(publication).map(|()| 0) })
}

/// Whether a hub lives there; answers 1 or 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_hub_lives(handle: *mut Opaque) -> c_int {
    answer(|| table::with(handle, |handle: &mut Handle| Ok(handle.hub_lives().into())))
}

/// What the last call of this thread that was refused said.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_error() -> *const c_char {
    call_error::last()
}

/// The version of this library.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_version() -> *const c_char {
    VERSION.as_ptr()
}

const VERSION: &CStr = match CStr::from_bytes_with_nul(concat!(env!("CARGO_PKG_VERSION"), "\0").as_bytes()) {
    Ok(version) => version,
    Err(_) => panic!("a version is no text"),
};

fn way(wait: c_int) -> Result<Wait, CallError> {
    match wait {
        0 => Ok(Wait::Doorbell),
        1 => Ok(Wait::Event),
        2 => Ok(Wait::Spin),
        _ => Err(CallError::Argument("there is no such way to wait", "one of SCANHUB_WAIT_..")),
    }
}

fn answer(call: impl FnOnce() -> Result<c_int, CallError>) -> c_int {
    let answered = catch_unwind(AssertUnwindSafe(call)).unwrap_or(Err(CallError::Bug));
    answered.unwrap_or_else(|error| error.keep())
}
