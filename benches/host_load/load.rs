//! What was used while a set-up ran, and what of it is the host's.

use crate::account::{Share, Span};
use crate::setup::Cast;
use crate::support::Outcome;
use crate::support::child::Child;

/// In percent of one processor.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Load {
    /// `/proc/stat`, all of it.
    pub(crate) machine: Share,
    /// Consumers and hub.
    pub(crate) processes: Share,
    /// Of it the hub.
    pub(crate) hub: Share,
    /// Threads of the kernel.
    pub(crate) kernel: f64,
    /// Who stands for hardware.
    pub(crate) outside: Share,
    /// Who looks at it all: this process.
    pub(crate) bench: Share,
    /// All processes and threads of the kernel that were there at the end.
    pub(crate) everybody: f64,
    /// What the machine below took away.
    pub(crate) stolen: f64,
    /// Scans a second of the consumer and sensor that had the fewest.
    pub(crate) hz: f64,
}

/// The host's load by two accounts, in percent of one processor.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Host {
    /// By `/proc/stat`, less who is no part of the host.
    pub(crate) machine: Share,
    /// By the processes of consumers and hub.
    pub(crate) processes: Share,
}

impl Load {
    /// What was used in `span` by these processes.
    pub(crate) fn of(span: &Span<'_>, cast: &Cast, hz: f64) -> Outcome<Load> {
        let hub = span.of(&pids(&cast.hub))?;
        Ok(Load {
            machine: span.machine(),
            processes: span.of(&pids(&cast.consumers))?.plus(hub),
            hub,
            kernel: span.kernel(),
            outside: span.of(&pids(&cast.outside))?,
            bench: span.of(&[std::process::id()])?,
            everybody: span.everybody(),
            stolen: span.stolen(),
            hz,
        })
    }

    /// What of it is the host's. On a loopback a datagram is delivered in the call of who sends it; on a network the
    /// interrupt of whoever receives it does that. So what a sender took beyond one whom nobody hears, `deaf`, is the
    /// host's; in all other set-ups `deaf` is not needed.
    pub(crate) fn of_host(&self, deaf: Option<Share>) -> Host {
        let delivery = deaf.map_or(0.0, |deaf| (self.outside.total() - deaf.total()).max(0.0));
        let delivery = Share { user: 0.0, system: delivery };
        Host {
            machine: self.machine.less(self.outside).less(self.bench).plus(delivery),
            processes: self.processes.plus(delivery),
        }
    }
}

fn pids<'a>(children: impl IntoIterator<Item = &'a Child>) -> Vec<u32> {
    children.into_iter().map(|child| child.guard.pid()).collect()
}
