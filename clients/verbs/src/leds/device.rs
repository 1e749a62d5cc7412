//! An LED of the machine, which Linux provides as a directory of files (Documentation/leds/leds-class.rst). The files
//! are written only when the state of the LED changes. An LED that was unavailable is used again when it returns. Time
//! is an argument.

use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use scanhub_schema::{Failure, Kind};

/// Interval between attempts to switch an LED that has failed.
const RETRY_INTERVAL: Duration = Duration::from_secs(1);

/// An LED.
pub(super) struct Device {
    directory: PathBuf,
    /// Whether the LED is on; `None` if that is unknown.
    is_on: Option<bool>,
    /// Time of the next attempt after a failure.
    retry_at: Option<Instant>,
}

/// Change of an LED's availability.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum DeviceEvent {
    /// The LED can no longer be switched.
    Failed(Failure),
    /// The LED can be switched again.
    Recovered,
}

impl Device {
    /// Opens the LED `name` in `root`, and switches it off. If a trigger of the kernel controlled the LED until now,
    /// also returns this trigger.
    ///
    /// # Errors
    ///
    /// - [`Kind::Configuration`] if the LED does not exist; the hint lists the existing LEDs.
    /// - [`Kind::Failed`] if this user may not switch it; the hint names its owner.
    pub(super) fn open(root: &Path, name: &str) -> Result<(Device, Option<String>), Failure> {
        if !root.is_dir() {
            let message = format!("{} is not a directory", root.display());
            return Err(Failure::new(
                Kind::Configuration,
                message,
                "--led-root names the directory with the LEDs",
            ));
        }
        let directory = root.join(name);
        let is_name = !name.is_empty() && !name.contains('/') && name != "." && name != "..";
        if !is_name || !directory.join(BRIGHTNESS).is_file() {
            let message = format!("{} has no LED {name:?}", root.display());
            return Err(Failure::new(Kind::Configuration, message, available_leds(root)));
        }
        let mut device = Device { directory, is_on: None, retry_at: None };
        let trigger = device.trigger();
        device.take().map_err(|error| device.failure(&error))?;
        Ok((device, trigger))
    }

    /// Switches the LED on if `on` is set, and otherwise off. Does nothing if the LED has this state already. Returns
    /// an event if the LED has failed or recovered.
    pub(super) fn show(&mut self, on: bool, now: Instant) -> Option<DeviceEvent> {
        if self.is_on == Some(on) || self.retry_at.is_some_and(|at| now < at) {
            return None;
        }
        // After a failure, take the LED over again: if it was unplugged, it is in the state that it has after power-on.
        let taken = if self.retry_at.is_some() { self.take() } else { Ok(()) };
        match taken.and_then(|()| self.switch(on)) {
            Ok(()) => self.retry_at.take().map(|_| DeviceEvent::Recovered),
            Err(error) => {
                self.is_on = None;
                let is_new = self.retry_at.replace(now + RETRY_INTERVAL).is_none();
                is_new.then(|| DeviceEvent::Failed(self.failure(&error)))
            }
        }
    }

    /// Switches the LED off, and ends its trigger. The trigger would otherwise continue to control the LED.
    fn take(&mut self) -> io::Result<()> {
        if self.trigger().is_some() {
            // Ignore an error: this write may be forbidden even if switching is allowed. Switching the LED off also
            // ends a trigger.
            let _ = write(&self.directory.join(TRIGGER), b"none\n");
        }
        self.switch(false)
    }

    fn switch(&mut self, on: bool) -> io::Result<()> {
        let brightness = if on { self.brightest()? } else { 0 };
        write(&self.directory.join(BRIGHTNESS), format!("{brightness}\n").as_bytes())?;
        self.is_on = Some(on);
        Ok(())
    }

    fn brightest(&self) -> io::Result<u32> {
        let text = fs::read_to_string(self.directory.join("max_brightness"))?;
        text.trim().parse().map_err(|_| io::Error::other(format!("its max_brightness is {:?}", text.trim())))
    }

    /// Returns the active trigger, which is the word in brackets, unless it is `none`.
    fn trigger(&self) -> Option<String> {
        let text = fs::read_to_string(self.directory.join(TRIGGER)).ok()?;
        let (_, rest) = text.split_once('[')?;
        let (active, _) = rest.split_once(']')?;
        (active != "none").then(|| active.to_owned())
    }

    fn failure(&self, error: &io::Error) -> Failure {
        let path = self.directory.join(BRIGHTNESS);
        let message = format!("{} cannot be written: {error}", path.display());
        let hint = match (error.kind(), fs::metadata(&path)) {
            (io::ErrorKind::PermissionDenied, Ok(found)) => {
                let (mode, uid, gid) = (found.mode() & 0o777, found.uid(), found.gid());
                format!(
                    "it belongs to user {uid} and group {gid} with mode {mode:04o}; a udev rule opens it: \
                     SUBSYSTEM==\"leds\", ACTION==\"add\", RUN+=\"/bin/chgrp GROUP /sys%p/brightness\", \
                     RUN+=\"/bin/chmod 0664 /sys%p/brightness\", with a GROUP that this user is in"
                )
            }
            (io::ErrorKind::NotFound, _) => "it was disconnected; it is tried again every second".to_owned(),
            _ => "it is tried again every second".to_owned(),
        };
        Failure::new(Kind::Failed, message, hint)
    }
}

/// Writes to an existing file, and never creates one.
fn write(path: &Path, content: &[u8]) -> io::Result<()> {
    File::options().write(true).truncate(true).open(path)?.write_all(content)
}

fn available_leds(root: &Path) -> String {
    let entries = fs::read_dir(root).into_iter().flatten().flatten();
    let mut names: Vec<_> = entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    match &names[..] {
        [] => "there are none: --led-root names another directory".to_owned(),
        names => format!("there are {}", names.join(", ")),
    }
}

const BRIGHTNESS: &str = "brightness";
const TRIGGER: &str = "trigger";

#[cfg(test)]
mod tests {
    use super::*;
    use tempfile::TempDir;

    /// Directory that the tests use as the kernel's LED directory.
    struct Root(TempDir);

    impl Root {
        fn new() -> Root {
            Root(TempDir::new().unwrap())
        }

        fn plug(&self, name: &str, trigger: &str) {
            fs::create_dir(self.0.path().join(name)).unwrap();
            for (file, content) in [(BRIGHTNESS, "77\n"), ("max_brightness", "255\n"), (TRIGGER, trigger)] {
                fs::write(self.0.path().join(name).join(file), content).unwrap();
            }
        }

        fn unplug(&self, name: &str) {
            fs::remove_dir_all(self.0.path().join(name)).unwrap();
        }

        fn brightness(&self, name: &str) -> String {
            fs::read_to_string(self.0.path().join(name).join(BRIGHTNESS)).unwrap()
        }
    }

    #[test]
    fn led_is_written_only_on_a_change() {
        let (root, now) = (Root::new(), Instant::now());
        root.plug("red", "[none] timer\n");
        let (mut red, trigger) = Device::open(root.0.path(), "red").unwrap();
        assert_eq!((trigger, root.brightness("red").as_str()), (None, "0\n"));
        assert_eq!((red.show(true, now), root.brightness("red").as_str()), (None, "255\n"));
        // The device did not write the LED again, so the value that another program has set stays.
        fs::write(root.0.path().join("red").join(BRIGHTNESS), "3\n").unwrap();
        assert_eq!((red.show(true, now), root.brightness("red").as_str()), (None, "3\n"));
        assert_eq!((red.show(false, now), root.brightness("red").as_str()), (None, "0\n"));
    }

    #[test]
    fn opening_an_led_disables_its_trigger() {
        let root = Root::new();
        root.plug("red", "none timer [heartbeat]\n");
        let (_, trigger) = Device::open(root.0.path(), "red").unwrap();
        assert_eq!(trigger.as_deref(), Some("heartbeat"));
        assert_eq!(fs::read_to_string(root.0.path().join("red").join(TRIGGER)).unwrap(), "none\n");
    }

    #[test]
    fn unknown_led_is_refused_with_available_names() {
        let root = Root::new();
        for (plugged, hint) in [("", "there are none"), ("red", "there are red")] {
            if !plugged.is_empty() {
                root.plug(plugged, "");
            }
            let nowhere = Device::open(&root.0.path().join("nowhere"), "red").err().unwrap();
            assert!(nowhere.message.ends_with("/nowhere is not a directory"), "{nowhere}");
            for name in ["blue", "", "..", "red/../red"] {
                let failure = Device::open(root.0.path(), name).err().unwrap();
                assert_eq!(failure.kind, Kind::Configuration, "{name}");
                assert!(failure.message.contains(&format!("has no LED {name:?}")), "{failure}");
                assert!(failure.hint.starts_with(hint), "{failure}");
            }
        }
    }

    #[test]
    fn unplugged_led_is_reported_once_and_resumes_later() {
        let (root, start) = (Root::new(), Instant::now());
        root.plug("red", "[none]\n");
        let (mut red, _) = Device::open(root.0.path(), "red").unwrap();
        root.unplug("red");
        let Some(DeviceEvent::Failed(failure)) = red.show(true, start) else { panic!("no failure") };
        assert!(failure.message.contains("red/brightness cannot be written"), "{failure}");
        assert_eq!(red.show(true, start + RETRY_INTERVAL), None, "reported already");
        root.plug("red", "[timer]\n");
        assert_eq!(
            (red.show(true, start + RETRY_INTERVAL), root.brightness("red").as_str()),
            (None, "77\n"),
            "too early"
        );
        assert_eq!(red.show(true, start + 2 * RETRY_INTERVAL), Some(DeviceEvent::Recovered));
        assert_eq!(root.brightness("red"), "255\n");
        assert_eq!(fs::read_to_string(root.0.path().join("red").join(TRIGGER)).unwrap(), "none\n");
    }

    #[test]
    fn non_numeric_max_brightness_is_reported() {
        let root = Root::new();
        root.plug("red", "[none]\n");
        let (mut red, _) = Device::open(root.0.path(), "red").unwrap();
        fs::write(root.0.path().join("red").join("max_brightness"), "bright\n").unwrap();
        let Some(DeviceEvent::Failed(failure)) = red.show(true, Instant::now()) else { panic!("no failure") };
        assert!(failure.message.contains("its max_brightness is \"bright\""), "{failure}");
    }
}
