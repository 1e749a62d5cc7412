//! Invariant on recordings: a recording contains each telegram of each sensor with its header, in order, and the number
//! of missing telegrams. The real writer writes the recording into memory, and the real reader reads it. A recorded
//! world takes about twice as long to run, so only one world in four is recorded.

use std::collections::BTreeMap;
use std::io::{self, Write};

use bytemuck::pod_read_unaligned;
use rustix::fs::{MemfdFlags, memfd_create};
use scanhub_drivers::lms::variant::{Mode, Unit};
use scanhub_recording::{Encoding, Recording as File};
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::file::Writer;
use scanhub_schema::{Header, Nanos, Status, Topic};

use super::{Invariant, ViolationReporter};
use crate::event::Event;
use crate::hash::HistoryHash;
use crate::setup::Setup;
use crate::subscriber::SubscriberId;
use crate::topics::Sample;

/// A recorder of all telegrams and statuses.
pub(crate) struct Recording {
    /// Sensor and topic of each subscriber whose samples are recorded.
    subscriptions: BTreeMap<SubscriberId, (usize, Topic)>,
    writer: Option<Writer<Vec<u8>>>,
    /// Header and hash of each telegram that was recorded.
    taken: BTreeMap<usize, Vec<(Header, u64)>>,
    missed: BTreeMap<usize, u64>,
}

impl Recording {
    /// Records the world if `seed` is a multiple of [`RECORDING_INTERVAL`].
    pub(crate) fn new(seed: u64) -> Recording {
        let begin = || Writer::begin(Vec::new(), "", BTreeMap::new());
        Recording {
            subscriptions: BTreeMap::new(),
            writer: seed.is_multiple_of(RECORDING_INTERVAL).then(begin).and_then(Result::ok),
            taken: BTreeMap::new(),
            missed: BTreeMap::new(),
        }
    }

    fn record(&mut self, sensor: usize, sample: &Sample, missed: u64) -> io::Result<()> {
        let Some(writer) = &mut self.writer else { return Ok(()) };
        let (name, Sample { topic, header, bytes, .. }) = (Setup::name(sensor), sample);
        if *topic == Topic::Status {
            let status: Status = pod_read_unaligned(bytes);
            let mut packed = [0; size_of::<Status>()];
            let len = status.pack(&mut packed).ok_or(io::ErrorKind::StorageFull)?;
            return writer.write_sample(&name, *topic, header, &packed[..len]);
        }
        self.taken.entry(sensor).or_default().push((*header, HistoryHash::hash_bytes(bytes)));
        *self.missed.entry(sensor).or_default() += missed;
        writer.write_sample(&name, *topic, header, bytes)
    }

    /// Reads the recording. Returns a description of the difference between the samples read and the recorded samples,
    /// or `None` if they are equal.
    ///
    /// # Errors
    ///
    /// Returns a message if the recording cannot be written or read.
    fn read_back(&mut self) -> Result<Option<String>, String> {
        let Some(writer) = self.writer.take() else { return Ok(None) };
        let bytes = writer.finish().map_err(|error| error.to_string())?;
        let file = memfd_create("recording", MemfdFlags::CLOEXEC).map_err(|error| error.to_string())?;
        let path = format!("/proc/self/fd/{}", std::os::fd::AsRawFd::as_raw_fd(&file));
        std::fs::File::from(file.try_clone().map_err(|error| error.to_string())?)
            .write_all(&bytes)
            .map_err(|error| error.to_string())?;
        if self.taken.is_empty() {
            return Ok(None);
        }
        let whole = File::open(path).map_err(|failure| failure.to_string())?;
        for (&sensor, taken) in &self.taken {
            let part = whole.of(&Setup::name(sensor)).map_err(|failure| failure.to_string())?;
            let frames = part.telegrams(ENCODING).map_err(|failure| failure.to_string())?;
            let read: Vec<_> = frames
                .map(|frame| (frame.header.unwrap_or_default(), HistoryHash::hash_bytes(&frame.telegram)))
                .collect();
            let (missing, missed) = (part.contents().damage.telegrams, self.missed[&sensor]);
            // A reader cannot detect how many samples were missed from the end of one hub to the start of the next.
            if read != *taken || missing > missed {
                let (read, taken) = (read.len(), taken.len());
                return Ok(Some(format!(
                    "sensor {sensor}: {read} read of {taken}, {missing} missing of {missed}"
                )));
            }
        }
        Ok(None)
    }
}

impl Invariant for Recording {
    fn name(&self) -> &'static str {
        "recording"
    }

    fn on_event(&mut self, _: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::Attached { subscriber, sensor, topic, is_prompt: true, .. } => {
                let is_wanted = matches!(topic, Topic::Telegram | Topic::Status);
                // Only the first subscriber of each topic is recorded.
                if is_wanted && self.subscriptions.values().all(|known| *known != (sensor, topic)) {
                    self.subscriptions.insert(subscriber, (sensor, topic));
                }
            }
            Event::Taken { subscriber, sample, missed } => {
                if let Some(&(sensor, _)) = self.subscriptions.get(&subscriber)
                    && let Err(error) = self.record(sensor, sample, missed)
                {
                    reporter.report(format!("sensor {sensor}: not written: {error}"));
                }
            }
            Event::WorldEnded { .. } => match self.read_back() {
                Ok(None) => {}
                Ok(Some(words)) | Err(words) => reporter.report(words),
            },
            _ => {}
        }
    }
}

/// Interval of seeds at which worlds are recorded.
const RECORDING_INTERVAL: u64 = 4;
/// Encoding of the telegrams. The reader has a parameter for it, and uses it only for logs that are not recordings of a
/// hub.
const ENCODING: Encoding = Encoding { unit: Unit::Mm, mode: Mode(1) };
