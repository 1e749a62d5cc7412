//! What is known of a robot, as C sees it: its verdict, and each sensor's. Owns the texts that C may read as long as it is
//! lent.

use std::ffi::{CString, c_char};
use std::ptr;

use scanhub_client::Robot;

/// `scanhub_robot` of the header.
#[repr(C)]
pub(crate) struct Verdict {
    verdict: u8,
    nearest_mm: u32,
    worst: *const c_char,
    nearest: *const c_char,
    count: usize,
    sensors: *const OfSensor,
}

/// `scanhub_robot_sensor` of the header.
#[repr(C)]
struct OfSensor {
    name: *const c_char,
    verdict: u8,
    nearest_mm: u32,
}

/// The verdict, and all that it points to.
pub(crate) struct Told {
    verdict: Verdict,
    _sensors: Box<[OfSensor]>,
    _names: Vec<CString>,
}

impl Told {
    /// What is known now.
    pub(crate) fn new(robot: &Robot) -> Told {
        // Names have no 0 in them.
        let names: Vec<CString> =
            robot.zones().map(|(name, _)| CString::new(name).unwrap_or_default()).collect();
        let of_sensor = |((_, zones), name): ((&str, &scanhub_schema::Zones), &CString)| OfSensor {
            name: name.as_ptr(),
            verdict: zones.verdict() as u8,
            nearest_mm: zones.nearest().map_or(NOTHING_MM, |(_, mm)| mm),
        };
        let sensors: Box<[OfSensor]> = robot.zones().zip(&names).map(of_sensor).collect();
        let called = |wanted: Option<&str>| {
            let at = robot.zones().position(|(name, _)| Some(name) == wanted);
            at.map_or(ptr::null(), |at| names[at].as_ptr())
        };
        let nearest = robot.nearest();
        let verdict = Verdict {
            verdict: robot.verdict() as u8,
            nearest_mm: nearest.map_or(NOTHING_MM, |(mm, _)| mm),
            worst: called(robot.worst()),
            nearest: called(nearest.map(|(_, name)| name)),
            count: sensors.len(),
            sensors: sensors.as_ptr(),
        };
        Told { verdict, _sensors: sensors, _names: names }
    }

    /// What is lent; what it points to lives as long as this.
    pub(crate) fn verdict(&self) -> &Verdict {
        &self.verdict
    }
}

/// SCANHUB_NOTHING_MM of the header.
const NOTHING_MM: u32 = u32::MAX;
