//! Sleeping at several wake services at once. Hides what consumers are woken by; refuses to know why they wait.

use std::thread;
use std::time::Duration;

use iceoryx2::port::listener::ListenerWaitError;
use iceoryx2::prelude::{CallbackProgression, SignalHandlingMode, WaitSetBuilder};

use super::{Listener, Service};
use crate::{Failure, Kind};

/// Sleeps until one of `listeners` is woken, a signal comes or `timeout` is over, and takes all that woke it:
/// receive what there is before the next sleep, notifications coalesce.
///
/// [`Kind::Short`] if there are too few descriptors to wait with.
pub fn sleep(listeners: &[&Listener], timeout: Duration) -> Result<(), Failure> {
    match listeners {
        [] => thread::sleep(timeout),
        [one] => match one.timed_wait(|_| {}, timeout) {
            Ok(_) | Err(ListenerWaitError::InterruptSignal) => {}
            Err(error) => return Err(broken(&error)),
        },
        several => {
            let set = WaitSetBuilder::new()
                .signal_handling_mode(SignalHandlingMode::Disabled)
                .create::<Service>()
                .map_err(|error| broken(&error))?;
            let guards: Result<Vec<_>, _> = several.iter().map(|one| set.attach_notification(*one)).collect();
            let guards = guards.map_err(|error| broken(&error))?;
            set.wait_and_process_once_with_timeout(|_| CallbackProgression::Continue, timeout)
                .map_err(|error| broken(&error))?;
            drop(guards);
            for one in several {
                match one.try_wait(|_| {}) {
                    Ok(_) | Err(ListenerWaitError::InterruptSignal) => {}
                    Err(error) => return Err(broken(&error)),
                }
            }
        }
    }
    Ok(())
}

fn broken(error: &dyn std::fmt::Debug) -> Failure {
    Failure::new(Kind::Short, format!("cannot wait for the hub: {error:?}"), "`ulimit -n` may be too small")
}
