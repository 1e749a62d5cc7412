//! Description of a scanner family: its models and settings, and the steps with which the search recognizes a scanner
//! of the family. [`crate::search`] runs the steps of [`SearchSteps`] and passes the received bytes to a [`Probe`].

use core::fmt;

use scanhub_schema::{Family, Nanos};

use crate::settings::Key;

/// Models and settings of a family.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Features {
    /// The family's models. Empty if the scanner reports its model.
    pub models: &'static [Model],
    /// Values for a scanner whose model is unknown: the baud rate that the hub uses first, and the number of beams for
    /// which it reserves space.
    pub defaults: Model,
    /// Names of the scan modes. Empty if the family has only one mode.
    pub modes: &'static [&'static str],
    /// Settings that only this family has.
    pub keys: &'static [Key],
    /// Whether the hub can stop the motor.
    pub can_stop_motor: bool,
    /// Whether the scanner streams as soon as it has power, without a request.
    pub streams_unrequested: bool,
    /// Whether each telegram is a complete scan or a complete reply. Otherwise the scanner sends packets, and several
    /// packets form a scan.
    pub has_whole_telegrams: bool,
    /// Whether the scanner reports its settings outside a session, to a [probe](crate::identity_probe).
    pub has_identity_probe: bool,
    /// Flags for the arrays that a scan contains: bits of [`scanhub_schema::ArrayFlags`].
    pub array_flags: u8,
    /// Maximum length of a telegram, or of packets that arrive together, in bytes.
    pub max_telegram: usize,
}

/// A model of a scanner.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Model {
    /// Name in the configuration and in messages.
    pub name: &'static str,
    /// Baud rate of the scanner's line, in bits per second.
    pub baud: u32,
    /// Default number of beams of a scan.
    pub beams: usize,
}

/// Declares an enum of the models or scan modes of a family, each with its name in configurations.
macro_rules! named {
    ($(#[doc = $doc:literal])+ $Enum:ident { $($(#[doc = $text:literal])+ $Name:ident $name:literal,)+ }) => {
        $(#[doc = $doc])+
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum $Enum {
            $($(#[doc = $text])+ $Name,)+
        }

        impl $Enum {
            /// Every variant, in the order of declaration.
            pub const ALL: [$Enum; [$($name),+].len()] = [$($Enum::$Name),+];

            /// Returns the name in configurations and messages.
            pub const fn name(self) -> &'static str {
                match self { $($Enum::$Name => $name,)+ }
            }
        }
    };
}
pub(crate) use named;

/// Applies a constant function to every element of a constant array.
macro_rules! table {
    ($from:expr, $map:path) => {{
        let mut to = [$map($from[0]); $from.len()];
        let mut at = 1;
        while at < to.len() {
            to[at] = $map($from[at]);
            at += 1;
        }
        to
    }};
}
pub(crate) use table;

/// Recognizer of one family's scanners in the bytes of a line.
pub trait Probe: fmt::Debug + Send {
    /// Returns the rates, steps and requests with which the search tries to find this family.
    fn search_steps(&self) -> &'static SearchSteps;

    /// Discards all bytes, because the baud rate has changed. After the call, the probe expects no reply.
    fn clear(&mut self);

    /// Sets whether the search waits for a reply to a request of this family.
    fn expect_reply(&mut self, is_expected: bool) {
        let _ = is_expected;
    }

    /// Handles bytes from the line.
    fn receive(&mut self, bytes: &[u8]);

    /// Returns how long the line must be idle before [`release`](Self::release) may accept ambiguous bytes. Returns
    /// `None` if no bytes are ambiguous.
    fn hold_time(&self) -> Option<Nanos> {
        None
    }

    /// Handles a read that returned no bytes. `idle` is the time since the last byte.
    fn release(&mut self, idle: Nanos) {
        let _ = idle;
    }

    /// Returns what the bytes since the last [`clear`](Self::clear) prove about the scanner.
    fn evidence(&self) -> Evidence;
}

/// Evidence about the scanner in the received bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Evidence {
    /// The bytes prove nothing.
    None,
    /// The bytes may be a damaged transmission of the family. The search should repeat the request.
    Damaged,
    /// The bytes may be the start of a transmission of the family. The search should wait for its end.
    Partial,
    /// The bytes look like a stream of the family. Only a reply can prove the family.
    Stream,
    /// The scanner belongs to the family. Contains the model, if the scanner has reported its model.
    Found(Option<&'static str>),
}

/// Baud rates and requests with which the search may find a family.
#[derive(Clone, Copy, Debug)]
pub struct SearchSteps {
    /// The family that the search can find with these steps.
    pub family: Family,
    /// Steps that only listen, in the order in which they run.
    pub listen_steps: &'static [ListenStep],
    /// Steps that send requests. `None` for a family whose scanners accept no requests.
    pub request_steps: Option<RequestSteps>,
    /// Baud rate at which a scanner sends its boot message, in bits per second. Between two rounds, the search pauses
    /// at this rate.
    pub boot_rate: Option<u32>,
    /// Maximum length of a transmission from the scanner, in bytes.
    pub max_transmission: usize,
    /// Part of the message that the hub shows if the search found no scanner. It names the properties of the scanner
    /// that the user should check.
    pub advice: &'static str,
}

impl SearchSteps {
    /// Returns all baud rates at which the search tries to find the family, in bits per second, in increasing order.
    pub fn rates(&self) -> Vec<u32> {
        let request_rates = self.request_steps.map_or(&[][..], |requests| requests.rates);
        let mut rates: Vec<u32> = self.listen_steps.iter().map(|step| step.rate).collect();
        rates.extend(request_rates);
        rates.sort_unstable();
        rates.dedup();
        rates
    }
}

/// Step that listens at one baud rate.
#[derive(Clone, Copy, Debug)]
pub struct ListenStep {
    /// Baud rate in bits per second.
    pub rate: u32,
    /// Duration of the step.
    pub duration: Nanos,
    /// Whether a search round skips the step if no byte has arrived in this round.
    pub needs_bytes: bool,
}

/// Steps that send requests. Each baud rate has its own step.
#[derive(Clone, Copy, Debug)]
pub struct RequestSteps {
    /// Baud rates in bits per second, the most likely one first.
    pub rates: &'static [u32],
    /// Time that the search waits from a change of the baud rate to the first byte of a request.
    pub settle_time: Nanos,
    /// Request that stops a stream. The search sends this request before any other request.
    pub stop: Option<StopRequest>,
    /// Requests to which the scanner replies. Each round of the search uses the next request.
    pub requests: &'static [&'static [u8]],
    /// Minimum and maximum time between the end of one byte of a request and the start of the next byte. `None` if the
    /// scanner accepts any gap, so that one write can send the whole request.
    pub gap: Option<(Nanos, Nanos)>,
    /// Maximum time from the last byte of the request to the first byte of the reply.
    pub reply_timeout: Nanos,
    /// Additional time for the reply in every second round, for slow scanners.
    pub extra_reply_time: Nanos,
    /// Additional time for the rest of a reply that has [begun](Evidence::Partial).
    pub extra_partial_time: Nanos,
    /// Number of times that the search sends the request in every second round. In any round, the search also repeats a
    /// request if the reply may have been [damaged](Evidence::Damaged).
    pub repeats: u8,
}

/// Request that stops a stream, and the time to wait for the end of the stream.
#[derive(Clone, Copy, Debug)]
pub struct StopRequest {
    /// Bytes of the request.
    pub request: &'static [u8],
    /// Time without a byte after which the stream has ended.
    pub quiet_time: Nanos,
    /// Maximum time to wait for the end of the stream. After this time, the search sends its next request even if bytes
    /// still arrive.
    pub max_wait: Nanos,
}
