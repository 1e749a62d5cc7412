//! Hub in virtual time, which can drive many sensors faster than in real time.
//!
//! The test passes bytes with the time at which they arrived. The topics in shared memory are published by the same
//! code as for a serial line. Bytes that a session sends to its scanner are stored until the test takes them.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::io;
use std::path::Path;
use std::rc::Rc;

use scanhub_config::Config;
use scanhub_daemon::platform::{Platform, PortIo, SavedState, Wait, WakeReason};
use scanhub_daemon::{CommandSender, LiveLink};
use scanhub_port::{PortError, PortSpec, ReadBudget, SettingsChange, clock};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{DoorbellWord, Failure, Nanos, WakeEvent};
use scanhub_shm::{Domain, HubLock, resource_limits};
use scanhub_shm::{Node, Payload, SharedMemory, WakeSender};

/// Link in virtual time. In the configuration, its port must be a recording (`file:`). The session then expects scans
/// from the start, and decodes them in the configured mode.
pub(crate) struct VirtualLink<'a> {
    platform: &'a VirtualPlatform<'a>,
    link: LiveLink<'a, VirtualPlatform<'a>>,
    due_ns: Nanos,
}

/// Creates the links of `config` in `domain`, and passes them to `drive`. Does not open the ports of the links. The
/// links end when `drive` returns.
///
/// # Errors
///
/// Returns an error if another hub holds the domain, or if its topics cannot be created.
pub(crate) fn virtual_hub<T>(
    config: &Config,
    domain: &Domain,
    drive: impl FnOnce(&mut [VirtualLink<'_>]) -> T,
) -> Result<T, Failure> {
    resource_limits::raise_descriptor_limit().expect("the limit of descriptors can be raised");
    let _lock = HubLock::acquire(domain.root())?;
    let node = scanhub_shm::hub_node(domain)?;
    let (_commands, queues) = CommandSender::new(config.links.iter().map(|link| link.name.as_str()))?;
    let platform = config.links.iter().map(|link| VirtualPlatform::new(&node, &link.name));
    let platform = platform.collect::<Result<Vec<_>, _>>()?;
    let mut links = Vec::with_capacity(config.links.len());
    for (((number, link), platform), queue) in config.links.iter().enumerate().zip(&platform).zip(queues) {
        let mut link = LiveLink::new(link, number as u8, 0, platform, queue)?;
        let Wait { until: due_ns, .. } = link.on_wakeup(WakeReason::Timeout);
        links.push(VirtualLink { platform, link, due_ns });
    }
    scanhub_shm::allocate(domain)?;
    Ok(drive(&mut links))
}

impl VirtualLink<'_> {
    /// Passes `bytes` that arrived in one read at `now`. The link first publishes everything that became due before
    /// `now`. It then publishes the telegrams that these bytes complete, and their number is returned.
    pub(crate) fn read(&mut self, now: Nanos, bytes: &[u8]) -> usize {
        self.platform.telegrams.set(0);
        while self.due_ns < now {
            self.platform.now.set(self.due_ns);
            self.turn(WakeReason::Timeout);
        }
        self.platform.now.set(now);
        self.platform.line.0.borrow_mut().extend(bytes);
        while !self.platform.line.0.borrow().is_empty() {
            self.turn(WakeReason::Ready);
        }
        self.platform.telegrams.get()
    }

    /// Makes the port reject the baud rates `rates`.
    #[allow(dead_code, reason = "not every program that includes this module has such a port")]
    pub(crate) fn reject(&mut self, rates: &[u32]) {
        *self.platform.line.1.borrow_mut() = rates.to_vec();
    }

    /// Returns the bytes that the session has sent since the last call.
    #[allow(dead_code, reason = "not every program that includes this module has a sensor that receives")]
    pub(crate) fn take_written(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.platform.line.2.borrow_mut())
    }

    fn turn(&mut self, woken: WakeReason) {
        let Wait { until, .. } = self.link.on_wakeup(woken);
        self.due_ns = until;
    }
}

/// Platform of a link: a clock that only the test advances, bytes in memory, and the shared memory of a domain.
struct VirtualPlatform<'a> {
    node: &'a Node,
    waker: WakeSender,
    now: Cell<Nanos>,
    /// Nanoseconds that are added to the clock to get the wall-clock time since 1970.
    wall_ahead_ns: u64,
    line: Bytes,
    /// Number of telegrams that the link has published since the last call of [`VirtualLink::read`] began.
    telegrams: Cell<usize>,
}

/// Port in memory. The fields are the bytes that have arrived but were not read yet, the baud rates that the port
/// rejects, and the bytes that the session has written.
#[derive(Clone, Default)]
struct Bytes(Rc<RefCell<VecDeque<u8>>>, Rc<RefCell<Vec<u32>>>, Rc<RefCell<Vec<u8>>>);

impl<'a> VirtualPlatform<'a> {
    fn new(node: &'a Node, sensor: &str) -> Result<Self, Failure> {
        let wall_ahead_ns = clock::wall_ns() - clock::now();
        Ok(VirtualPlatform {
            node,
            waker: WakeSender::new(node, sensor)?,
            now: Cell::new(0),
            wall_ahead_ns,
            line: Bytes::default(),
            telegrams: Cell::new(0),
        })
    }
}

impl Platform for VirtualPlatform<'_> {
    type Port = Bytes;
    type Transport<P: Payload + ?Sized> = SharedMemory<P>;

    fn now(&self) -> Nanos {
        self.now.get()
    }

    fn wall_ns(&self) -> u64 {
        self.now.get() + self.wall_ahead_ns
    }

    fn pause(&self, _: Nanos) {}

    fn take_name(&self) -> Result<(), Failure> {
        Ok(())
    }

    fn open(&self, _: &PortSpec, _: u32) -> Option<Result<Bytes, PortError>> {
        Some(Ok(self.line.clone()))
    }

    fn explain(&self, error: &PortError, source: &PortSpec) -> Failure {
        error.explain(source)
    }

    fn altering_program(&self, _: &PortSpec) -> Option<String> {
        None
    }

    fn take_kept_port(&self, _: &str, _: &PortSpec, _: u32) -> Option<Bytes> {
        None
    }

    fn keep_open(&self, _: &str, _: &Bytes) {}

    fn release(&self, _: &str) {}

    fn transport<P: Payload + ?Sized>(&self, sensor: &str) -> Result<SharedMemory<P>, Failure> {
        SharedMemory::new(self.node, sensor, &TopicLimits::default())
    }

    fn attach_count(&self) -> Option<u32> {
        Some(self.waker.attached())
    }

    fn has_listeners(&self) -> bool {
        // `notify_event` counts the telegrams, so it must be called even without subscribers.
        true
    }

    fn ring(&self, ring: DoorbellWord) {
        self.waker.ring(ring);
    }

    fn notify_event(&self, why: WakeEvent) {
        if why == WakeEvent::Telegram {
            self.telegrams.set(self.telegrams.get() + 1);
        }
        self.waker.notify(why).expect("subscribers can be woken");
    }

    fn load_record(&self, _: &str, _: &mut [u8]) -> Option<usize> {
        None
    }

    fn store_record(&self, _: &str, _: &[u8]) {}

    fn saved_state(&self) -> Option<&dyn SavedState> {
        None
    }
}

impl PortIo for Bytes {
    fn read(&self, buffer: &mut [u8]) -> io::Result<usize> {
        let mut bytes = self.0.borrow_mut();
        let len = buffer.len().min(bytes.len());
        buffer.iter_mut().zip(bytes.drain(..len)).for_each(|(place, byte)| *place = byte);
        Ok(len)
    }

    fn write(&self, bytes: &[u8]) -> io::Result<()> {
        self.2.borrow_mut().extend(bytes);
        Ok(())
    }

    fn set_baud(&self, baud: u32) -> io::Result<Option<io::Error>> {
        let is_rejected = self.1.borrow().contains(&baud);
        Ok(is_rejected.then(|| io::Error::other(format!("the port cannot have {baud} baud"))))
    }

    fn alteration(&self) -> io::Result<Option<SettingsChange>> {
        Ok(None)
    }

    fn restore(&self, _: u32) -> io::Result<()> {
        Ok(())
    }

    fn set_dtr(&self, _: bool) -> io::Result<()> {
        Ok(())
    }

    fn buffered_len(&self) -> Option<usize> {
        None
    }

    fn read_budget(&self, _: u32) -> Option<ReadBudget> {
        None
    }

    fn line_errors(&self) -> u64 {
        0
    }

    fn device(&self) -> Option<&Path> {
        None
    }

    fn is_simulated(&self) -> bool {
        false
    }
}
