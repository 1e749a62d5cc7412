//! Finds the places at which a stream file needs responses of the scanner that its recording does not contain. A recording may
//! begin after the scanner has sent them, and the packets alone may not define how to read them.

use scanhub_drivers::line::{Session as _, suspect};
use scanhub_drivers::{Session, Settings, features};
use schema::{Failure, Family, Header, Kind, MILLIS, Nanos};

use crate::{Encoding, Form, Recording, VirtualTime};

/// Returns the missing responses, each with the number of the frame before which they belong.
///
/// # Errors
///
/// Returns the errors of [`Recording::telegrams`], and [`Kind::Input`] if nothing in the recording defines how its packets must
/// be read.
pub(super) fn stream_heads(recording: &Recording) -> Result<Vec<(usize, Vec<u8>)>, Failure> {
    let contents = recording.contents();
    // A stream file has no times, without which the time per point cannot be measured.
    let family = recording.family().filter(|_| contents.form == Form::Mcap);
    let Some(family) = family.filter(|family| !features(*family).has_whole_telegrams) else {
        return Ok(Vec::new());
    };
    let settings = recording.session_settings().map_err(|_| without_status(recording))?;
    let settings = Settings { beams: None, ..settings };
    let status = contents.sensor_type.as_ref().filter(|(number, _)| *number == family as u8);
    let reported = status.map_or("", |(_, text)| text);
    let (mut heads, mut is_guess) = (Vec::new(), false);
    let mut close = |stream: Stream| {
        let session = stream.session.session();
        let head = session.stream_head(reported, recording.beams());
        if !head.is_empty() {
            // Without a model, neither a status nor the scanner has confirmed the time per point.
            is_guess |= status.is_none() && session.model_text().is_none();
            heads.push((stream.at, head));
        }
    };
    let mut open: Option<Stream> = None;
    for (number, frame) in recording.telegrams(Encoding::default())?.enumerate() {
        let Some(header) = frame.header.filter(|header| header.family == family as u8) else { continue };
        let is_reply = family.packets(&frame.telegram).is_some_and(|facts| facts.kind == REPLY);
        if let Some(ended) = open.take_if(|stream| !stream.continues_with(&header, is_reply)) {
            close(ended);
        }
        let stream = open.get_or_insert_with(|| Stream::begin(family, settings, number, &header, is_reply));
        stream.take(number, &header, &frame.telegram, is_reply);
    }
    open.into_iter().for_each(&mut close);
    if is_guess {
        return Err(without_status(recording));
    }
    Ok(heads)
}

/// Returns the failure of a recording whose packets can be read in several ways.
fn without_status(recording: &Recording) -> Failure {
    let message = format!(
        "recording {} has neither the topic status nor the scanner's responses, without which its packets cannot be read",
        recording.path().display()
    );
    Failure::new(Kind::Input, message, "record NAME/status too, as `record` does by default")
}

/// A stream of packets, and the responses before it.
struct Stream {
    /// Run of the hub.
    boot: u64,
    /// Number of the frame before which missing responses belong: the last response before the packets, or the first frame if
    /// there is none.
    at: usize,
    /// Stamp of its first packets. `None` before they have arrived.
    packets_since: Option<Nanos>,
    session: VirtualTime<Session>,
}

impl Stream {
    /// Creates the stream that begins with the frame `number`, which has this `header`. The mode in `settings` is that of the
    /// recording's first status. It is not used for a scanner that reports its modes.
    fn begin(family: Family, settings: Settings, number: usize, header: &Header, is_reply: bool) -> Stream {
        let (begun, mode) = (header.stamp_first_ns, settings.mode.filter(|_| !is_reply));
        let session = Session::begin(family, &Settings { mode, ..settings }, begun);
        Stream {
            boot: header.boot,
            at: number,
            packets_since: None,
            session: VirtualTime::new(session, begun),
        }
    }

    /// Returns whether the frame with this `header` belongs to it. A frame of another run of the hub does not, and neither does a
    /// response after packets.
    fn continues_with(&self, header: &Header, is_reply: bool) -> bool {
        header.boot == self.boot && !(is_reply && self.packets_since.is_some())
    }

    /// Handles the telegram of the frame `number`.
    fn take(&mut self, number: usize, header: &Header, telegram: &[u8], is_reply: bool) {
        if is_reply {
            self.at = number;
        } else {
            let since = *self.packets_since.get_or_insert(header.stamp_first_ns);
            if header.stamp_first_ns >= since.saturating_add(MEASURED) {
                return;
            }
        }
        // As on a line, an error of the line concerns the packets alone.
        self.session.session_mut().mark_suspect(header.reasons & !suspect::LINE_ERROR);
        self.session.take(header.stamp_last_ns, telegram, |_| {});
    }
}

/// Kind of a telegram that is a response.
const REPLY: &str = "reply";
/// Time for which the packets of a stream are measured.
const MEASURED: Nanos = 4_000 * MILLIS;
