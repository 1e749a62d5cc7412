//! A receiving process: takes message after message, looks at it, and says when it had each in hand and what that cost it.
//! Refuses to know by what it comes.

use super::message::Label;
use super::schedule::PHASES;
use super::sender::{Task, busy_ns, text};
use super::way::Way;
use super::{datagrams, floors, streams, topic};
use crate::support::{Outcome, clock};

/// A mechanism's receiving end.
pub(crate) trait Inlet {
    /// Waits for the next message and looks at it.
    fn next(&mut self) -> Outcome<Label>;
}

/// Receives all phases. Prints `ready` when nothing that is sent from now on would be missed, and for each phase `took
/// BUSY_NS`, then the number and the time of every message.
pub(crate) fn play(task: &Task, number: usize, address: &str) -> Outcome<()> {
    let mut inlet = inlet(task, number, address)?;
    println!("ready");
    for (current, phase) in PHASES.iter().enumerate() {
        let mut took = Vec::with_capacity(2 * phase.count(task.way));
        let before = busy_ns();
        loop {
            let label = inlet.next()?;
            let now = clock::now();
            match label {
                Label { phase, .. } if phase != current => {}
                Label { is_end: true, .. } => break,
                Label { number, .. } => took.extend([number, now]),
            }
        }
        let busy = busy_ns() - before;
        println!("took {busy} {}", text(&took));
    }
    drop(inlet);
    println!("end");
    Ok(())
}

fn inlet(task: &Task, number: usize, address: &str) -> Outcome<Box<dyn Inlet>> {
    Ok(match task.way {
        Way::Doorbell | Way::Event | Way::Spin => Box::new(topic::BytesInlet::new(task)?),
        Way::Subscription => Box::new(topic::ScansInlet::new(task)?),
        Way::Multicast | Way::UnixDatagram => {
            Box::new(datagrams::DatagramsInlet::new(task, number, address)?)
        }
        Way::UnixStream | Way::Tcp | Way::Pipe => Box::new(streams::StreamInlet::new(task, number, address)?),
        Way::FutexFloor | Way::SpinFloor => Box::new(floors::WordInlet::new(task)?),
        Way::EventfdFloor => Box::new(floors::CounterInlet::new(task)?),
    })
}
