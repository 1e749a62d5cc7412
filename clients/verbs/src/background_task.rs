//! Slow work in a thread of its own, so that the sending thread waits only for samples. Refuses to know what the work
//! is.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread;
use std::time::Duration;

/// Work in a thread of its own. Dropped, nobody waits for its result any more.
#[derive(Debug)]
pub struct BackgroundTask<T>(Receiver<T>);

/// So often it is seen that nobody wants to wait any more.
const LOOK_EVERY: Duration = Duration::from_millis(50);

impl<T: Send + 'static> BackgroundTask<T> {
    /// Begins it; nothing if there is no thread to be had: then it is to be tried again.
    pub fn begin(work: impl FnOnce() -> T + Send + 'static) -> Option<BackgroundTask<T>> {
        let (done, result) = channel();
        let thread = thread::Builder::new().name("errand".into()).spawn(move || {
            let _ = done.send(work());
        });
        thread.ok().map(|_| BackgroundTask(result))
    }

    /// Its result, once, as soon as there is one.
    pub fn result(&self) -> Option<T> {
        self.0.try_recv().ok()
    }

    /// Its result, waited for; nothing if `stop` is set before there is one.
    pub fn wait(&self, stop: &AtomicBool) -> Option<T> {
        while !stop.load(Ordering::Relaxed) {
            match self.0.recv_timeout(LOOK_EVERY) {
                Err(RecvTimeoutError::Timeout) => {}
                result => return result.ok(),
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;

    #[test]
    fn nobody_waits_for_it() {
        let (go, hold) = channel();
        let task = BackgroundTask::begin(move || hold.recv()).unwrap();
        assert_eq!(task.result(), None);
        go.send(7).unwrap();
        let give_up_at = Instant::now() + Duration::from_secs(30);
        let result = loop {
            match task.result() {
                Some(result) => break result,
                None => assert!(Instant::now() < give_up_at),
            }
            thread::yield_now();
        };
        assert_eq!((result, task.result()), (Ok(7), None));
    }

    #[test]
    fn who_waits_for_it_can_be_stopped() {
        let (go, hold) = channel();
        let task = BackgroundTask::begin(move || hold.recv()).unwrap();
        assert_eq!(task.wait(&AtomicBool::new(true)), None);
        go.send(7).unwrap();
        assert_eq!(task.wait(&AtomicBool::new(false)), Some(Ok(7)));
    }
}
