//! A simulated LMS, without I/O. Its inputs are bytes of the host and times, and its outputs are chunks of bytes with
//! the times of their transmission. The caller drives the LMS as a [`Device`]. [`ScanSource`] provides the measured
//! values, and [`crate::line_model`] damages the bytes later.
//!
//! The scanner supports every request that a host sends before a stream, every mode that sends measured values, and the
//! requests of the installation mode that change the configuration and the permanent rate. It refuses every other
//! well-formed request with 92h, as a real scanner refuses a request that it does not support. It counts the requests
//! that would write its EEPROM. Tests check this count to prove that automatic code never sends such a request.

use std::collections::VecDeque;
use std::ops::Range;

use scanhub_drivers::lms::command::{self, EEPROM_WRITES, Password, Request};
use scanhub_drivers::lms::configuration::{OLD_CONFIGURATION_LEN, REAL_TIME_INDICES, factory_configuration};
use scanhub_drivers::lms::lms_model::LmsModel;
use scanhub_drivers::lms::operating::Operating as Asked;
use scanhub_drivers::lms::reply::{self, SimulatedStatus};
use scanhub_drivers::lms::telegram::{ACK, EncodedTelegram, NAK, REPLY, Telegram, Writer};
use scanhub_drivers::lms::variant::{Baud, MIRROR_PERIOD, Mode, Unit, Variant};
use scanhub_lms_configure::eeprom::{self, EepromWrite, PowerOn};
use scanhub_schema::{MILLIS, Nanos};

use crate::device::{Chunk, ChunkKind, Device, SentTelegram};
use crate::device::{ChunkSize, Transmission};
use crate::operating::ScanSource;
use crate::operating::{MeasuredValues, OperatingMode};
use crate::request_decoder::{Arrival, DecodedRequest, DroppedRequest, RequestDecoder};

/// A scanner at time 0: its type, its EEPROM, the state in which an earlier host left it, and the hardware at the
/// host's end of its line.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Address of the scanner, 0 to 127. It replies to requests for this address and for 0.
    pub address: u8,
    /// Reply to 3Ah: by convention 21 ASCII characters. If it names an LMS 211, the scanner sees only 100 degrees.
    pub type_name: String,
    /// Rate of the line. After a power cycle, it is [`Settings::permanent_baud`] or 9600.
    pub baud: Baud,
    /// Rate at power-on in the EEPROM, written with 66h; `None` means 9600.
    pub permanent_baud: Option<Baud>,
    /// Angle and resolution at power-on.
    pub variant: Variant,
    /// Unit of the ranges, in the EEPROM.
    pub unit: Unit,
    /// Meaning of the 16 bits of a value, in the EEPROM.
    pub mode: Mode,
    /// Byte 4 of the configuration: bit 1 appends scan and telegram index to measured values.
    pub availability: u8,
    /// Length of the configuration in bytes: 34, or 32 with older firmware.
    pub configuration_len: usize,
    /// State in which an earlier host left the scanner.
    pub start: StartState,
    /// Time from power-on to the boot message 90h. A real scanner needs up to 60 s.
    pub boot_ns: Nanos,
    /// Byte that ends each reply. It is 10h for a healthy scanner, and 11h after some events (Telegram listing 8).
    pub status: u8,
    /// Pairs of type and number, as in the reply to 32h (Telegram listing, B2h).
    pub errors: Vec<(u8, u8)>,
    /// Transparency of the front window, in percent of the transparency of a clean window. Below 75, the scanner
    /// reports a warning, and below 30 an error.
    pub pollution_percent: u16,
    /// Deviations from the listing.
    pub quirks: ProtocolQuirks,
    /// Number of bytes that the host's hardware delivers at once.
    pub chunk: ChunkSize,
    /// Speed of the simulation's time relative to the host's time. The host measures the gaps between the bytes of its
    /// requests by its own clock.
    pub speed: f64,
    /// Seed of the random delays before replies, and of the deviations.
    pub seed: u64,
}

impl Default for Settings {
    /// Returns an LMS 200 with factory settings, except for mode 1: millimeters and reflector levels.
    fn default() -> Self {
        Settings {
            address: 0,
            type_name: "LMS200;301063;V02.30 ".into(),
            baud: Baud::B9600,
            permanent_baud: None,
            variant: Variant::HALF,
            unit: Unit::Mm,
            mode: Mode(1),
            availability: 0,
            configuration_len: 34,
            start: StartState::Operating(OperatingMode::OnRequest),
            boot_ns: 2_000 * MILLIS,
            status: 0x10,
            errors: Vec::new(),
            pollution_percent: 100,
            quirks: ProtocolQuirks::default(),
            chunk: ChunkSize::Uart,
            speed: 1.0,
            seed: 0,
        }
    }
}

/// State of a scanner at time 0.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StartState {
    /// The start-up is complete, and the scanner is in this operating mode.
    Operating(OperatingMode),
    /// The power is switched on now. After a silence, the scanner sends the boot message.
    PowerOn,
}

/// Deviations of a scanner from the listing. Real scanners deviate occasionally.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ProtocolQuirks {
    /// Share of the requests that the scanner overlooks while its mirror rotates.
    pub overlooked_share: f64,
    /// Share of the intact requests that the scanner answers with NAK.
    pub nak_share: f64,
    /// Share of the replies that the scanner sends twice.
    pub doubled_share: f64,
    /// Additional time from a request to its ACK.
    pub late_acknowledge_ns: Nanos,
    /// Additional delay of a reply. The reply is sent even if the next request arrives before it.
    pub late_reply_ns: Nanos,
    /// Additional duration of a change of mode, rate or variant: up to 3 s by the listing. If a request arrives during
    /// the change, the scanner answers this request immediately, and never sends the reply to the change.
    pub late_mode_ns: Nanos,
    /// Additional duration of a write to the EEPROM. SICK's quick manual allows 7 s.
    pub late_write_ns: Nanos,
    /// Whether the scanner refuses requests to measure with 92h while it is in installation mode. The host must first
    /// select the monitoring mode (Telegram listing 6.3.2; table 7-1 of the listing allows measuring).
    pub is_strict: bool,
    /// Whether the scanner drops requests whose bytes arrive less than 55 us apart (Telegram listing 4.3). Most hosts
    /// do not keep this minimum.
    pub checks_gaps: bool,
    /// Time from each ACK to the reply; 0 selects a random time in the range of real scanners.
    pub reply_delay_ns: Nanos,
    /// Commands that the scanner refuses with 92h.
    pub refused_commands: Vec<u8>,
    /// Whether the scanner sends no replies. A stream continues.
    pub is_mute: bool,
}

/// A simulated LMS.
pub struct LmsSimulator {
    pub(crate) settings: Settings,
    pub(crate) source: ScanSource,
    eeprom: Eeprom,
    pub(crate) operating: OperatingMode,
    pub(crate) variant: Variant,
    baud: Baud,
    decoder: RequestDecoder,
    pub(crate) random: fastrand::Rng,
    quirks: fastrand::Rng,
    queue: VecDeque<Transmission<Tag>>,
    /// Start of the transmission of the next scan; `None` while there is no stream.
    next_scan_ns: Option<Nanos>,
    /// End of the start-up. Bytes that arrive before the end of the start-up are ignored.
    started_ns: Nanos,
    /// Number of telegrams with measured values since power-on.
    scans: u64,
    /// Number of partial scans since the last change of the operating mode.
    pub(crate) partials: u64,
}

/// Purpose of a transmission.
#[derive(Clone, Copy, Debug)]
enum Tag {
    Acknowledge,
    Scan,
    Reply {
        /// Whether the scanner sends the reply even if another request arrives before it.
        is_late: bool,
        effect: ReplyEffect,
    },
}

/// A reply to a request.
struct Reply {
    telegram: Vec<u8>,
    /// Minimum time from the ACK to the reply.
    delay_ns: Nanos,
    effect: ReplyEffect,
}

/// Action of the scanner after the transmission of a reply.
#[derive(Clone, Copy, Debug)]
enum ReplyEffect {
    Nothing,
    /// Changes the rate of the line.
    Baud(Baud),
    /// Restarts the scanner.
    Reset,
}

impl LmsSimulator {
    /// Creates the scanner with `settings`, at time 0.
    pub fn new(settings: Settings, source: ScanSource) -> Self {
        let mut machine = LmsSimulator {
            eeprom: Eeprom::new(&settings),
            operating: OperatingMode::OnRequest,
            variant: settings.variant,
            baud: settings.baud,
            decoder: RequestDecoder::new(settings.speed, settings.quirks.checks_gaps),
            random: fastrand::Rng::with_seed(settings.seed),
            quirks: fastrand::Rng::with_seed(!settings.seed),
            settings,
            source,
            queue: VecDeque::new(),
            next_scan_ns: None,
            started_ns: 0,
            scans: 0,
            partials: 0,
        };
        match machine.settings.start.clone() {
            StartState::Operating(operating) => {
                machine.next_scan_ns = operating.streams().then_some(0);
                machine.operating = operating;
            }
            StartState::PowerOn => machine.boot(0),
        }
        machine
    }

    /// Returns the present rate of the line.
    pub fn baud(&self) -> Baud {
        self.baud
    }

    /// Returns the present operating mode.
    pub fn operating(&self) -> &OperatingMode {
        &self.operating
    }

    /// Changes the deviations from now on.
    pub fn set_quirks(&mut self, quirks: ProtocolQuirks) {
        self.decoder.is_strict = quirks.checks_gaps;
        self.settings.quirks = quirks;
    }

    /// Returns a telegram of measured values in mode `operating`, with a scan that ended at `at_ns`.
    fn measure(&mut self, operating: &OperatingMode, at_ns: Nanos) -> Option<Vec<u8>> {
        let (variant, unit, mode) = (self.variant, self.eeprom.unit(), self.eeprom.mode());
        let Settings { address, status, .. } = self.settings;
        let index = self.eeprom.has_indices().then_some(self.scans as u8);
        let revolution = self.partials;
        self.scans += 1;
        self.partials += u64::from(*operating == OperatingMode::Partial);
        let shot =
            |room| MeasuredValues { room, variant, unit, mode, at_ns, address, status, index, revolution };
        self.source.telegram(operating, shot)
    }

    /// Puts the next scan of the stream on the line if it is due.
    fn start_scan(&mut self, now: Nanos) {
        let Some(start_ns) = self.next_scan_ns.filter(|&at| at <= now) else { return };
        // After the end of a recording, the line stays open and silent.
        self.next_scan_ns = None;
        let operating = self.operating.clone();
        let Some(telegram) = self.measure(&operating, start_ns) else { return };
        let period_ns = operating.period(self.variant, telegram.len(), self.baud.rate());
        self.next_scan_ns = Some(start_ns + period_ns);
        self.send(telegram, start_ns, Tag::Scan);
    }

    /// Removes the finished transmission from the queue, and carries out the action after it.
    fn finish_front(&mut self, part: ChunkKind) -> ChunkKind {
        let Some(front) = self.queue.pop_front() else { return part };
        let (end_ns, aborted) = (front.end_ns(), front.is_aborted());
        match front.tag {
            Tag::Reply { effect: ReplyEffect::Baud(baud), .. } => self.baud = baud,
            Tag::Reply { effect: ReplyEffect::Reset, .. } => self.boot(end_ns + RESET_NS),
            _ => {}
        }
        if let Some(next) = self.queue.front_mut() {
            next.start_no_earlier(end_ns);
        } else if self.operating.streams() && (aborted || !matches!(front.tag, Tag::Scan)) {
            // The stream continues with a complete scan, at the next time at which the mirror starts a scan.
            let scan_ns = self.operating.revolutions(self.variant) * MIRROR_PERIOD;
            self.next_scan_ns = Some(end_ns.next_multiple_of(scan_ns));
        }
        let (telegram, tag) = front.into_parts();
        match tag {
            Tag::Acknowledge => part,
            Tag::Scan | Tag::Reply { .. } => {
                ChunkKind::End(SentTelegram { is_reply: matches!(tag, Tag::Reply { .. }), telegram, aborted })
            }
        }
    }

    /// Interrupts all transmissions because of a request of the host. The current transmission ends with the byte in
    /// the transmitter, and queued transmissions are dropped, except late replies. Returns the time from which on the
    /// line is free.
    fn interrupt(&mut self, now: Nanos) -> Nanos {
        self.next_scan_ns = None;
        let mut is_first = true;
        self.queue.retain(|transmission| {
            let on_line = std::mem::take(&mut is_first) && transmission.start_ns() <= now;
            on_line || matches!(transmission.tag, Tag::Reply { is_late: true, .. })
        });
        let Some(front) = self.queue.front_mut().filter(|front| front.start_ns() <= now) else { return now };
        front.abort(now);
        front.end_ns().max(now)
    }

    /// Begins a start-up at `now`. The boot message is the first transmission.
    fn boot(&mut self, now: Nanos) {
        self.next_scan_ns = None;
        self.operating = OperatingMode::OnRequest;
        self.variant = self.settings.variant;
        self.baud = self.eeprom.power_on_baud();
        self.scans = 0;
        self.partials = 0;
        self.started_ns = now + self.settings.boot_ns;
        self.decoder = RequestDecoder::new(self.settings.speed, self.settings.quirks.checks_gaps);
        self.send(
            self.boot_message(),
            self.started_ns,
            Tag::Reply { is_late: false, effect: ReplyEffect::Nothing },
        );
    }

    /// Queues `bytes` for transmission from `start_ns` on, before transmissions that start later. Returns the time at
    /// which the last byte ends.
    fn send(&mut self, bytes: Vec<u8>, start_ns: Nanos, tag: Tag) -> Nanos {
        let transmission = Transmission::new(bytes, start_ns, self.baud.rate(), self.settings.chunk, tag);
        let end_ns = transmission.end_ns();
        let index = self.queue.partition_point(|other| other.start_ns() <= start_ns);
        self.queue.insert(index, transmission);
        end_ns
    }

    fn draw(&mut self, share: f64) -> bool {
        share > 0.0 && self.quirks.f64() < share
    }

    /// Returns the address byte of replies.
    fn reply_address(&self) -> u8 {
        self.settings.address | REPLY
    }

    /// Carries out `request` at `now`, and returns the reply.
    fn reply_to(&mut self, request: Telegram<'_>, now: Nanos) -> Reply {
        if EEPROM_WRITES.contains(&request.command()) {
            self.eeprom.writes += 1;
        }
        let command = request.command();
        let is_refused = self.settings.quirks.refused_commands.contains(&command);
        if is_refused || self.family().and_then(|family| family.refuses_command(command)).is_some() {
            return self.refusal();
        }
        let (address, status) = (self.settings.address, self.settings.status);
        match Request::decode(request) {
            Some(Request::Status) => delayed_reply(&self.status(), self.reply_delay_ns()),
            Some(Request::Type) => delayed_reply(
                &reply::type_reply(address, self.settings.type_name.as_bytes(), status),
                self.reply_delay_ns(),
            ),
            Some(Request::Configuration) => {
                let reply = self.reply(command::CONFIGURATION | REPLY, self.eeprom.configuration());
                delayed_reply(&reply, self.reply_delay_ns())
            }
            Some(Request::Errors) => {
                let pairs: Vec<u8> =
                    self.settings.errors.iter().flat_map(|&(kind, number)| [kind, number]).collect();
                delayed_reply(&self.reply(command::ERRORS | REPLY, &pairs), self.reply_delay_ns())
            }
            Some(Request::Counters) => self.counters(),
            Some(Request::Reset) => {
                self.settings.errors.clear();
                let announced = self.reply(reply::RESET, &[]);
                Reply { effect: ReplyEffect::Reset, ..delayed_reply(&announced, self.reply_delay_ns()) }
            }
            Some(Request::Variant(variant)) => {
                let done =
                    self.source.variant().is_none_or(|fixed| fixed == variant) && self.supports(variant);
                if done {
                    self.variant = variant;
                }
                delayed_reply(
                    &reply::variant_reply(address, done, self.variant, status),
                    self.mode_delay_ns(),
                )
            }
            Some(Request::Baud(baud)) => {
                let changed = reply::mode_reply(address, true, status);
                Reply { effect: ReplyEffect::Baud(baud), ..delayed_reply(&changed, self.mode_delay_ns()) }
            }
            Some(Request::Operate(Asked::Installation(password))) => match password {
                Password::FACTORY => self.change_mode(OperatingMode::Installation),
                _ => delayed_reply(&reply::mode_reply(address, false, status), self.mode_delay_ns()),
            },
            Some(mode_request) => match OperatingMode::of_request(mode_request, self.variant) {
                Some(operating) if self.source.supports(&operating) && self.can_start(&operating) => {
                    if mode_request.command() == command::MODE {
                        self.change_mode(operating)
                    } else {
                        self.measure_once(&operating, now)
                    }
                }
                _ => self.refusal(),
            },
            None => self.reply_to_other(request),
        }
    }

    /// Returns the boot message 90h.
    fn boot_message(&self) -> Vec<u8> {
        self.reply(reply::POWER_ON, self.settings.type_name.as_bytes()).bytes().to_vec()
    }

    /// Carries out a request that writes the EEPROM, or that [`Request`] does not decode.
    fn reply_to_other(&mut self, request: Telegram<'_>) -> Reply {
        let (address, status) = (self.settings.address, self.settings.status);
        let is_installation = self.operating == OperatingMode::Installation;
        match EepromWrite::decode(request) {
            Some(EepromWrite::Configuration(data)) if is_installation => {
                return self.write_configuration(data);
            }
            Some(EepromWrite::PowerOn(set @ (PowerOn::Baud9600 | PowerOn::KeepBaud))) if is_installation => {
                self.eeprom.permanent_baud = (set == PowerOn::KeepBaud).then(|| self.baud());
                let done = self.reply(eeprom::POWER_ON_RATE | REPLY, &[0, set.byte()]);
                return delayed_reply(&done, self.write_delay_ns(false));
            }
            _ => {}
        }
        match (request.command(), request.data()) {
            // An invalid variant.
            (command::VARIANT, [_, _, _, _]) => delayed_reply(
                &reply::variant_reply(address, false, self.variant, status),
                self.mode_delay_ns(),
            ),
            // The listing allows a word without a meaning in this request.
            (command::COUNTERS, [0, 0]) => self.counters(),
            _ => self.refusal(),
        }
    }

    fn counters(&mut self) -> Reply {
        delayed_reply(&self.reply(command::COUNTERS | REPLY, &OPERATING_COUNTERS), self.reply_delay_ns())
    }

    fn measure_once(&mut self, operating: &OperatingMode, now: Nanos) -> Reply {
        let delay_ns = operating.revolutions(self.variant) * MIRROR_PERIOD;
        let single =
            self.source.variant().is_none().then(|| self.measure(operating, now + delay_ns)).flatten();
        match single {
            Some(telegram) => Reply { telegram, delay_ns, effect: ReplyEffect::Nothing },
            None => self.refusal(),
        }
    }

    fn change_mode(&mut self, operating: OperatingMode) -> Reply {
        self.operating = operating;
        self.partials = 0;
        delayed_reply(
            &reply::mode_reply(self.settings.address, true, self.settings.status),
            self.mode_delay_ns(),
        )
    }

    /// Replaces the start of the configuration by `data` (request 77h in installation mode). A scanner that replays a
    /// recording refuses another unit or mode.
    fn write_configuration(&mut self, data: &[u8]) -> Reply {
        let (unit, mode) = (self.eeprom.unit(), self.eeprom.mode());
        let eeprom = self.eeprom.with_configuration(data).filter(|eeprom| {
            self.source.variant().is_none() || (eeprom.unit() == unit && eeprom.mode() == mode)
        });
        let done = eeprom.is_some();
        self.eeprom = eeprom.unwrap_or_else(|| self.eeprom.clone());
        let delay_ns = self.write_delay_ns(self.eeprom.unit() != unit);
        let outcome = [&[u8::from(done)], self.eeprom.configuration()].concat();
        delayed_reply(&self.reply(eeprom::CONFIGURATION | REPLY, &outcome), delay_ns)
    }

    /// Returns the status B1h: that of a healthy scanner, changed according to the settings and the errors of this
    /// scanner.
    fn status(&self) -> EncodedTelegram {
        let firmware = self.settings.type_name.rsplit(';').next().unwrap_or_default().as_bytes();
        let health = SimulatedStatus {
            software: std::array::from_fn(|at| firmware.get(at).copied().unwrap_or(b' ')),
            operating_mode: self.operating.code(),
            mode: self.eeprom.mode(),
            variant: self.variant,
            unit: self.eeprom.unit(),
            baud: self.baud(),
        };
        let healthy = reply::status_reply(self.settings.address, &health, self.settings.status);
        let mut data = healthy.telegram().data().to_vec();
        // Offsets in the data of B1h, counted from the byte after the command byte (Telegram listing 7-5).
        data[8] = u8::from(self.settings.errors.iter().any(|&(kind, _)| kind == FATAL_ERROR));
        let pollution = CLEAN_POLLUTION / 100 * self.settings.pollution_percent;
        for (at, words, value) in [(18, 12, pollution), (42, 12, CLEAN_POLLUTION)] {
            data[at..at + 2 * words].copy_from_slice(&value.to_le_bytes().repeat(words));
        }
        data[118] = u8::from(self.eeprom.permanent_baud.is_some());
        data[119] = self.settings.address;
        self.reply(healthy.telegram().command(), &data)
    }

    /// Returns the time from ACK to the reply to a request that changes nothing.
    fn reply_delay_ns(&mut self) -> Nanos {
        self.quirk_delay_ns(REPLY_DELAY_NS)
    }

    /// Returns the time from ACK to A0h or BBh, the replies to a change of mode, rate or variant.
    fn mode_delay_ns(&mut self) -> Nanos {
        self.quirk_delay_ns(MODE_CHANGE_NS) + self.settings.quirks.late_mode_ns
    }

    fn quirk_delay_ns(&mut self, usual: Range<Nanos>) -> Nanos {
        let random_ns = self.random.u64(usual);
        match self.settings.quirks.reply_delay_ns {
            0 => random_ns,
            answer_ns => answer_ns,
        }
    }

    /// Returns the time from ACK to F7h or E6h, the replies to a write to the EEPROM.
    fn write_delay_ns(&self, is_other_unit: bool) -> Nanos {
        let usual_ns = if is_other_unit { UNIT_CHANGE_NS } else { WRITE_NS };
        usual_ns + self.settings.quirks.late_write_ns
    }

    fn can_start(&self, operating: &OperatingMode) -> bool {
        let is_measuring = operating.streams();
        !(self.settings.quirks.is_strict && is_measuring) || self.operating != OperatingMode::Installation
    }

    fn family(&self) -> Option<LmsModel> {
        LmsModel::of_type(self.settings.type_name.as_bytes())
    }

    fn supports(&self, variant: Variant) -> bool {
        self.family().and_then(|family| family.refuses_variant(variant)).is_none()
    }

    fn refusal(&mut self) -> Reply {
        delayed_reply(&reply::refusal(self.settings.address, self.settings.status), self.reply_delay_ns())
    }

    fn reply(&self, command: u8, data: &[u8]) -> EncodedTelegram {
        Writer::new(self.reply_address(), command).slice(data).byte(self.settings.status).finish()
    }
}

impl Device for LmsSimulator {
    fn poll_transmit(&mut self, now: Nanos) -> Option<Chunk> {
        if self.queue.is_empty() {
            self.start_scan(now);
        }
        let front = self.queue.front_mut()?;
        let rate = front.rate();
        let (bytes, idle_after) = front.take_chunk(now)?;
        let bytes = bytes.to_vec();
        let part = match front.tag {
            Tag::Acknowledge => ChunkKind::Acknowledge,
            Tag::Scan | Tag::Reply { .. } => ChunkKind::Telegram,
        };
        let part = if front.is_done() { self.finish_front(part) } else { part };
        Some(Chunk { bytes, rate, idle_after, part })
    }

    fn poll_timeout(&self) -> Option<Nanos> {
        self.queue.front().map(Transmission::next_chunk_ns).or(self.next_scan_ns)
    }

    fn receive(&mut self, byte: u8, arrival: Arrival) {
        if arrival.not_after < self.started_ns {
            return;
        }
        let Some(DecodedRequest { bytes, at }) = self.decoder.receive(byte, arrival, self.baud.rate()) else {
            return;
        };
        let is_mine = bytes[1] == 0 || bytes[1] == self.settings.address;
        if !is_mine || self.settings.quirks.is_mute || self.draw(self.settings.quirks.overlooked_share) {
            return;
        }
        let free_ns = self.interrupt(at);
        let late_ns = self.settings.quirks.late_acknowledge_ns;
        let first_ns = free_ns + late_ns + self.random.u64(2 * MILLIS..8 * MILLIS);
        let request = Telegram::check(&bytes).filter(|_| !self.draw(self.settings.quirks.nak_share));
        let Some(request) = request else {
            self.send(vec![NAK], first_ns, Tag::Acknowledge);
            return;
        };
        let Reply { telegram: reply, delay_ns, effect: after } = self.reply_to(request, first_ns);
        let acknowledged_ns = self.send(vec![ACK], first_ns, Tag::Acknowledge);
        let late_ns = self.settings.quirks.late_reply_ns;
        let reply_ns = acknowledged_ns + delay_ns + late_ns;
        let late = late_ns > 0;
        let end_ns = self.send(reply.clone(), reply_ns, Tag::Reply { is_late: late, effect: after });
        if self.draw(self.settings.quirks.doubled_share) {
            let again_ns = end_ns + self.quirks.u64(..20 * MILLIS);
            self.send(reply, again_ns, Tag::Reply { is_late: late, effect: ReplyEffect::Nothing });
        }
    }

    /// Switches the power off and on. The transmission ends with the byte in the transmitter, and only the EEPROM
    /// remains. After the start-up, the scanner sends the boot message 90h at the permanent rate or at 9600. Returns
    /// whether a telegram was aborted.
    fn power_cycle(&mut self, now: Nanos) -> bool {
        self.queue.retain(|transmission| transmission.start_ns() <= now);
        self.queue.truncate(1);
        let mut broken = false;
        if let Some(front) = self.queue.front_mut() {
            front.abort(now);
            broken = front.is_aborted();
            if let Tag::Reply { effect: after, .. } = &mut front.tag {
                *after = ReplyEffect::Nothing;
            }
        }
        self.boot(now);
        broken
    }

    /// Aborts the current transmission as a request would, but handles no request. A stream continues with a complete
    /// scan.
    fn abort(&mut self, now: Nanos) {
        if self.queue.front().is_some_and(|front| front.start_ns() <= now) {
            self.interrupt(now);
        }
    }

    /// Returns the number of received requests that would write the EEPROM (40 42 46 66 77 7C), executed or refused.
    fn eeprom_writes(&self) -> u64 {
        self.eeprom.writes
    }

    fn take_dropped(&mut self) -> Option<DroppedRequest> {
        self.decoder.take_dropped()
    }

    fn rate(&self) -> u32 {
        self.baud.rate()
    }

    fn streams(&self) -> bool {
        self.operating.streams()
    }
}

fn delayed_reply(reply: &EncodedTelegram, delay_ns: Nanos) -> Reply {
    Reply { telegram: reply.bytes().to_vec(), delay_ns, effect: ReplyEffect::Nothing }
}

/// The part of the EEPROM that the simulation uses. It outlives a power cycle.
#[derive(Clone, Debug)]
struct Eeprom {
    /// Data of F4h: 34 bytes, 32 with older firmware.
    configuration: Vec<u8>,
    /// Rate at power-on; `None` means 9600.
    permanent_baud: Option<Baud>,
    /// Number of requests to write, executed or refused.
    writes: u64,
}

impl Eeprom {
    /// Creates an EEPROM with factory settings, except those in `settings` (Telegram listing, 77h).
    fn new(settings: &Settings) -> Eeprom {
        let mut configuration = factory_configuration(settings.mode, settings.unit).to_vec();
        configuration[AVAILABILITY] = settings.availability;
        configuration.truncate(settings.configuration_len.max(OLD_CONFIGURATION_LEN));
        Eeprom { configuration, permanent_baud: settings.permanent_baud, writes: 0 }
    }

    /// Returns the bytes of the configuration.
    fn configuration(&self) -> &[u8] {
        &self.configuration
    }

    fn mode(&self) -> Mode {
        Mode(self.configuration[MODE])
    }

    fn unit(&self) -> Unit {
        // `with_configuration` accepts only known units.
        Unit::of_code(self.configuration[UNIT]).unwrap_or(Unit::Mm)
    }

    /// Returns whether measured values end with scan and telegram index.
    fn has_indices(&self) -> bool {
        self.configuration[AVAILABILITY] & REAL_TIME_INDICES != 0
    }

    fn power_on_baud(&self) -> Baud {
        self.permanent_baud.unwrap_or(Baud::B9600)
    }

    /// Returns the EEPROM with the start of its configuration replaced by `data`, without excess bytes. Returns `None`
    /// if a scanner does not accept these settings.
    fn with_configuration(&self, data: &[u8]) -> Option<Eeprom> {
        let mut eeprom = self.clone();
        let len = data.len().min(self.configuration.len());
        eeprom.configuration[..len].copy_from_slice(&data[..len]);
        let is_known =
            MODES.contains(&eeprom.mode().0) && Unit::of_code(eeprom.configuration[UNIT]).is_some();
        is_known.then_some(eeprom)
    }
}

/// Time from 91h to the announced reset (Telegram listing, 10h).
const RESET_NS: Nanos = 10 * MILLIS;
/// Error type of a fatal error that is present now.
const FATAL_ERROR: u8 = 4;
/// Counters of a scanner that is some years old: operating time in units of 2 h, and number of power-ons.
const OPERATING_COUNTERS: [u8; 4] = [0x10, 0x27, 0x2C, 0x01];
/// Value that the pollution sensors report for a clean window. Only the ratio to this value matters.
const CLEAN_POLLUTION: u16 = 1_000;
/// Time from ACK to the reply to a request that changes nothing. Captured exchanges took 70 to 158 ms at 38400. The
/// transmission of request and reply took 10 to 45 ms of this time.
const REPLY_DELAY_NS: Range<Nanos> = 55 * MILLIS..145 * MILLIS;
/// Time from ACK to A0h or BBh. Captured exchanges took 66 to 94 ms; the listing allows 3 s.
const MODE_CHANGE_NS: Range<Nanos> = 55 * MILLIS..85 * MILLIS;
/// Time from ACK to F7h. A captured exchange took 130 ms.
const WRITE_NS: Nanos = 110 * MILLIS;
/// Time from ACK to F7h if the unit changes. SICK's quick manual allows 7 s.
const UNIT_CHANGE_NS: Nanos = 1_000 * MILLIS;
/// Indices of three bytes in the configuration (Telegram listing, 77h): [`Settings::availability`], measuring mode and
/// unit.
const AVAILABILITY: usize = 4;
const MODE: usize = 5;
const UNIT: usize = 6;
/// Measuring modes of the listing (77h block D), and the two measuring modes in which a scanner measures reflectivity
/// (reference 1.6).
const MODES: [u8; 11] = [0x00, 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x0D, 0x0E, 0x0F, 0x3F];
