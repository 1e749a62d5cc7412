//! Functions of the C header. Each of them calls one function of this crate. No panic leaves these functions, and each
//! error stores its message for `scanhub_error`.
#![allow(unsafe_code)] // For the unmangled names. No block in this file is unsafe.

use std::ffi::{CStr, c_char, c_int};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Duration;

use scanhub_client::Wait;
use scanhub_schema::{Tilt, Topic};

use crate::ffi::{
    BorrowedSample, CallError, last_message, optional_output, output, sample, text, write_names,
};
use crate::handle::{Handle, Mount, Opaque, insert, remove, with};
use crate::silence::{sensors, topics};

/// Subscribes to a topic. Returns 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_open(
    handle: *mut *mut Opaque,
    domain: *const c_char,
    sensor: *const c_char,
    topic: c_int,
    wait: c_int,
) -> c_int {
    answer(|| {
        let handle = output(handle)?;
        handle.write(std::ptr::null_mut());
        let sensor =
            text(sensor)?.ok_or(CallError::Argument("no sensor is named", "for example \"front\""))?;
        let topic = u8::try_from(topic).ok().and_then(Topic::of_number);
        let topic = topic.ok_or(CallError::Argument("there is no such topic", "one of SCANHUB_TOPIC_.."))?;
        let opened = Handle::open(text(domain)?, sensor, topic, wait_method(wait)?)?;
        handle.write(insert(opened)?);
        Ok(0)
    })
}

/// Subscribes to the verdict of a robot. Returns 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_open_robot(
    handle: *mut *mut Opaque,
    domain: *const c_char,
    sensors: *const c_char,
    wait: c_int,
) -> c_int {
    answer(|| open_robot(handle, domain, sensors, wait, false))
}

/// Subscribes to the verdict of a robot, with early warnings. Returns 0.
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
    let handle = output(handle)?;
    handle.write(std::ptr::null_mut());
    let sensors: Vec<&str> = text(sensors)?.unwrap_or_default().split_ascii_whitespace().collect();
    let opened = Handle::open_robot(text(domain)?, &sensors, wait_method(wait)?, early)?;
    handle.write(insert(opened)?);
    Ok(0)
}

/// Returns the descriptor to poll.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_fd(handle: *mut Opaque) -> c_int {
    answer(|| with(handle, |handle: &mut Handle| handle.descriptor()))
}

/// Waits for a sample. Returns 1 if there is one, and 0 after the timeout.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_wait(handle: *mut Opaque, timeout_ms: c_int) -> c_int {
    let timeout = u64::try_from(timeout_ms).ok().map(Duration::from_millis);
    answer(|| with(handle, |handle: &mut Handle| handle.wait(timeout)).map(c_int::from))
}

/// Lends the next sample. Returns 1 if a sample had arrived, and 0 otherwise.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_take(handle: *mut Opaque, taken: *mut BorrowedSample) -> c_int {
    answer(|| {
        let taken = output(taken)?;
        taken.write(BorrowedSample::none());
        match with(handle, Handle::take)? {
            Some(borrowed) => {
                taken.write(BorrowedSample { of: handle, ..borrowed });
                Ok(1)
            }
            None => Ok(0),
        }
    })
}

/// Releases a sample that was lent, and empties it. Returns 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_release(taken: *mut BorrowedSample) -> c_int {
    answer(|| {
        let taken = sample(taken)?;
        let BorrowedSample { of, number, .. } = *taken;
        // A sample without a handle was released or never filled, and needs no release. After an error, the sample
        // stays lent to the thread that took it.
        if !of.is_null() {
            with(of, |handle: &mut Handle| handle.release(number))?;
        }
        *taken = BorrowedSample::none();
        Ok(0)
    })
}

/// Ends the subscription, and releases all samples that it has lent. Returns 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_close(handle: *mut Opaque) -> c_int {
    answer(|| if handle.is_null() { Ok(0) } else { remove::<Handle>(handle).map(|()| 0) })
}

/// Starts to publish the angles of a mount. Returns 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_publish_tilt(
    publication: *mut *mut Opaque,
    domain: *const c_char,
    name: *const c_char,
) -> c_int {
    answer(|| {
        let publication = output(publication)?;
        publication.write(std::ptr::null_mut());
        let name = text(name)?.ok_or(CallError::Argument("no mount is named", "for example \"mount\""))?;
        publication.write(insert(Mount::publish(text(domain)?, name)?)?);
        Ok(0)
    })
}

/// Publishes an angle of the mount. Returns 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_send_tilt(
    publication: *mut Opaque,
    stamp_ns: u64,
    angle_rad: f64,
    rate_rad_s: f64,
) -> c_int {
    let tilt = Tilt { angle_rad, rate_rad_s };
    answer(|| with(publication, |mount: &mut Mount| mount.send(stamp_ns, tilt)).map(|()| 0))
}

/// Stops publishing and releases the name. Returns 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_unpublish(publication: *mut Opaque) -> c_int {
    answer(|| if publication.is_null() { Ok(0) } else { remove::<Mount>(publication).map(|()| 0) })
}

/// Returns 1 if a hub runs, and 0 otherwise.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_hub_is_running(handle: *mut Opaque) -> c_int {
    answer(|| with(handle, |handle: &mut Handle| Ok(handle.hub_is_running().into())))
}

/// Sets the time since the last sample, in ns. Returns 0.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_silent_for(handle: *mut Opaque, silent_ns: *mut u64) -> c_int {
    answer(|| {
        let silent_ns = output(silent_ns)?;
        silent_ns.write(0);
        let silent_for = with(handle, |handle: &mut Handle| Ok(handle.silent_for()))?;
        silent_ns.write(u64::try_from(silent_for.as_nanos()).unwrap_or(u64::MAX));
        Ok(0)
    })
}

/// Returns the reason why no sample arrives, and sets `text` to the text of the reason.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_why_silent(handle: *mut Opaque, text: *mut *const c_char) -> c_int {
    answer(|| {
        let mut text = optional_output(text)?;
        if let Some(text) = &mut text {
            text.write(c"".as_ptr());
        }
        with(handle, |handle: &mut Handle| {
            let (reason, message) = handle.why_silent();
            if let Some(text) = text {
                text.write(message.as_ptr());
            }
            Ok(reason)
        })
    })
}

/// Writes the names of the sensors in a domain. Returns the length of the complete text.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_sensors(domain: *const c_char, names: *mut c_char, size: usize) -> c_int {
    answer(|| write_names(&sensors(text(domain)?)?, names, size))
}

/// Writes the topics of all sensors in a domain. Returns the length of the complete text.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_topics(domain: *const c_char, names: *mut c_char, size: usize) -> c_int {
    answer(|| write_names(&topics(text(domain)?)?, names, size))
}

/// Returns the message of the last error of this thread.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_error() -> *const c_char {
    last_message()
}

/// Returns the version of this library.
#[unsafe(no_mangle)]
pub extern "C" fn scanhub_version() -> *const c_char {
    VERSION.as_ptr()
}

const VERSION: &CStr = match CStr::from_bytes_with_nul(concat!(env!("CARGO_PKG_VERSION"), "\0").as_bytes()) {
    Ok(version) => version,
    Err(_) => panic!("the version contains a 0"),
};

fn wait_method(wait: c_int) -> Result<Wait, CallError> {
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
