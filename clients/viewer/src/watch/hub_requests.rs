//! Requests to the hub while watching: reset, freeze or thaw the background. They run in a thread of their own,
//! because a slow hub must not delay the picture.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use scanhub_client::request;
use scanhub_schema::{Background, Failure, Request, Verb};
use scanhub_shm::Domain;

/// At most one order at a time.
#[derive(Default)]
pub(crate) struct HubRequests {
    running: Option<JoinHandle<Done>>,
    stop: Arc<AtomicBool>,
}

/// What became of an order.
pub(crate) struct Done {
    /// In words.
    pub(crate) news: String,
    /// The models afterwards, with their sensors.
    pub(crate) models: Vec<(String, Box<Background>)>,
}

impl HubRequests {
    /// Gives `verb` to the hub at `places` for each of `sensors`; not if it still works on the last one.
    pub(crate) fn give(&mut self, places: &[Domain], sensors: Vec<String>, verb: Verb) -> bool {
        if self.running.is_some() {
            return false;
        }
        let (places, stop) = (places.to_vec(), self.stop.clone());
        self.running = Some(std::thread::spawn(move || carry_out(&places, &sensors, verb, &stop)));
        true
    }

    /// What became of the order, once.
    pub(crate) fn done(&mut self) -> Option<Done> {
        self.running.take_if(|running| running.is_finished())?.join().ok()
    }
}

impl Drop for HubRequests {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        // It holds a place in the domain, which is to be given back.
        let _ = self.running.take().map(JoinHandle::join);
    }
}

fn carry_out(places: &[Domain], sensors: &[String], verb: Verb, stop: &AtomicBool) -> Done {
    let mut models = Vec::new();
    let mut order = |sensor: &String| -> Result<(), Failure> {
        request(places, &Request::new(sensor, verb), stop)?;
        let shown = request(places, &Request::new(sensor, Verb::Show), stop)?;
        models.extend(shown.map(|shown| (sensor.clone(), shown.model)));
        Ok(())
    };
    let news = match sensors.iter().try_for_each(&mut order) {
        Ok(()) => format!("{}: background {}", sensors.join(", "), outcome(verb)),
        Err(failure) => failure.to_string(),
    };
    Done { news, models }
}

fn outcome(verb: Verb) -> &'static str {
    match verb {
        Verb::Reset => "is learned again",
        Verb::Freeze => "is frozen",
        Verb::Thaw => "continues learning",
        other => other.name(),
    }
}
