//! Declarations of a family: the models and settings that a configuration can name, and how the search recognizes one of its
//! scanners on a line. [`crate::search`] runs the steps of an [`Approach`], and passes the bytes to a [`Probe`].

use core::fmt;

use scanhub_schema::{Family, Nanos};

use crate::settings::Key;

/// Models and settings of a family.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Features {
    /// The models. Empty if the scanner reports its model.
    pub models: &'static [Model],
    /// Values for an unknown model: the first rate, and the number of beams for which there is space.
    pub defaults: Model,
    /// Names of the scan modes. Empty if there is no choice.
    pub modes: &'static [&'static str],
    /// Keys of settings that only this family has.
    pub keys: &'static [Key],
    /// Whether the motor can be stopped.
    pub can_stop_motor: bool,
    /// Whether the scanner streams as soon as it has power, without a request.
    pub streams_unrequested: bool,
    /// Whether each telegram is a scan or a reply by itself. Otherwise the family sends packets, which are parts of a
    /// scan.
    pub has_whole_telegrams: bool,
    /// Whether the scanner reports its settings on request, outside a session: to an [inquiry](crate::inquiry).
    pub has_inquiry: bool,
    /// Arrays of a scan: bits of [`scanhub_schema::ArrayFlags`].
    pub array_flags: u8,
    /// Maximum number of bytes of a telegram, or of packets that arrived together.
    pub max_telegram: usize,
}

/// A model of a scanner.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Model {
    /// Name in the configuration and in messages.
    pub name: &'static str,
    /// Rate of its line, in bits per second.
    pub baud: u32,
    /// Default number of beams of a scan.
    pub beams: usize,
}

/// Declares the models or the modes of a family, each with its name in configurations.
macro_rules! named {
    ($(#[doc = $doc:literal])+ $Enum:ident { $($(#[doc = $text:literal])+ $Name:ident $name:literal,)+ }) => {
        $(#[doc = $doc])+
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum $Enum {
            $($(#[doc = $text])+ $Name,)+
        }

        impl $Enum {
            /// All of them.
            pub const ALL: [$Enum; [$($name),+].len()] = [$($Enum::$Name),+];

            /// Returns its name in configurations and messages.
            pub const fn name(self) -> &'static str {
                match self { $($Enum::$Name => $name,)+ }
            }
        }
    };
}
pub(crate) use named;

/// Maps a constant array with a constant function.
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

/// Recognizer of a family.
pub trait Probe: fmt::Debug + Send {
    /// Returns what the search may do to find this family.
    fn approach(&self) -> &'static Approach;

    /// Discards all bytes, because the rate has changed. No reply is expected.
    fn clear(&mut self);

    /// Sets whether a reply to the family's own request is expected.
    fn expect_reply(&mut self, is_expected: bool) {
        let _ = is_expected;
    }

    /// Handles bytes of the line.
    fn receive(&mut self, bytes: &[u8]);

    /// Returns how long the line must be idle until [`release`](Self::release) may accept bytes that are ambiguous so far. `None`
    /// if there are none.
    fn hold(&self) -> Option<Nanos> {
        None
    }

    /// A read found nothing, and no byte has arrived for `idle`.
    fn release(&mut self, idle: Nanos) {
        let _ = idle;
    }

    /// Returns what the bytes since the last [`clear`](Self::clear) prove.
    fn evidence(&self) -> Evidence;
}

/// Evidence about the scanner that has sent some bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Evidence {
    /// Nothing.
    None,
    /// A transmission of the family may have been damaged. It is worth sending the request again.
    Damaged,
    /// A transmission of the family may have begun. It is worth waiting for its end.
    Partial,
    /// The bytes look like a stream of the family. A reply is needed to prove it.
    Stream,
    /// The scanner belongs to the family, and to this model if it has reported one.
    Found(Option<&'static str>),
}

/// Rates and requests by which the search may find a family.
#[derive(Clone, Copy, Debug)]
pub struct Approach {
    /// The family.
    pub family: Family,
    /// Steps without a request, in this order.
    pub listen_steps: &'static [ListenStep],
    /// Steps with a request. `None` for a family that never gets a byte.
    pub request_steps: Option<RequestSteps>,
    /// Rate at which a scanner reports that it has started, in bits per second. The search pauses at this rate.
    pub boot_rate: Option<u32>,
    /// Maximum number of bytes of a transmission.
    pub max_transmission: usize,
    /// Properties of the scanner that the user should check if it is not found, as part of a message.
    pub advice: &'static str,
}

impl Approach {
    /// Returns the rates at which the search looks for the family, in bits per second, in increasing order.
    pub fn rates(&self) -> Vec<u32> {
        let request_rates = self.request_steps.map_or(&[][..], |asks| asks.rates);
        let mut rates: Vec<u32> = self.listen_steps.iter().map(|step| step.rate).collect();
        rates.extend(request_rates);
        rates.sort_unstable();
        rates.dedup();
        rates
    }
}

/// Step that only listens.
#[derive(Clone, Copy, Debug)]
pub struct ListenStep {
    /// Rate in bits per second.
    pub rate: u32,
    /// Duration.
    pub duration: Nanos,
    /// Whether the step is skipped in a round in which no byte has arrived.
    pub needs_bytes: bool,
}

/// Steps that send a request at one rate after the other.
#[derive(Clone, Copy, Debug)]
pub struct RequestSteps {
    /// Rates in bits per second, the likeliest first.
    pub rates: &'static [u32],
    /// Time between a change of the rate and the first byte.
    pub settle_time: Nanos,
    /// Request that stops a stream. It is sent first.
    pub stop: Option<StopRequest>,
    /// Requests for a reply. Every round uses the next one.
    pub requests: &'static [&'static [u8]],
    /// Minimum and maximum time between the end of a byte and the next one. `None` if the scanner accepts any time: then
    /// a request is one write.
    pub gap: Option<(Nanos, Nanos)>,
    /// Time for the reply to begin, from the last byte of the request.
    pub reply_timeout: Nanos,
    /// Additional time for the reply in every second round, for slow scanners.
    pub extra_reply_time: Nanos,
    /// Additional time for a reply that has [begun](Evidence::Partial).
    pub extra_partial_time: Nanos,
    /// Number of times that the request is sent in every second round. A request whose reply may have been
    /// [damaged](Evidence::Damaged) is sent again in any round.
    pub repeats: u8,
}

/// Request that stops a stream, and the wait for the end of the stream.
#[derive(Clone, Copy, Debug)]
pub struct StopRequest {
    /// The request.
    pub request: &'static [u8],
    /// The stream has ended when no byte has arrived for this time.
    pub quiet_time: Nanos,
    /// After this time, the search sends its request even if bytes still arrive.
    pub max_wait: Nanos,
}
