//! Sending machine in virtual time: a hub with two sensors, and a gateway. Sensors fall silent, and hub and gateway
//! restart. The machine keeps all datagrams that it has sent.

use std::collections::BTreeMap;
use std::num::NonZeroU64;

use fastrand::Rng;
use scanhub_client::clock::Timestamp;
use scanhub_client::streams::ZonesState;
use scanhub_network::lan::WallTimestamp;
use scanhub_network::lan::outgoing::{Form, Outgoing, PayloadRef, Sample, Transmit};
use scanhub_schema::datagram::Datagram;
use scanhub_schema::{Header, Status, Topic, Verdict, Zones};

use crate::network::{Nanos, Network};

/// Faults of the sending machine.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct MachineFaults {
    /// Whether sensors fall silent.
    pub(crate) silence: bool,
    /// Whether the hub restarts.
    pub(crate) hub: bool,
    /// Whether a restart of the hub may change the order of its sensors.
    pub(crate) order: bool,
    /// Whether the gateway restarts.
    pub(crate) gateway: bool,
    /// Probability that the kernel refuses a datagram.
    pub(crate) refusal: f64,
}

/// Number of the gateway.
pub(crate) const HUB_ID: u64 = 0xab;
/// Names of the sensors. Zones of the sensor at position n have n in `invalid_beams`.
pub(crate) const NAMES: [&str; 2] = ["front", "rear"];
/// Time between two scans.
pub(crate) const PERIOD_NS: Nanos = 26_640_000;
const SECOND_NS: Nanos = 1_000_000_000;
/// Time after the last scan at which the hub publishes an unknown verdict.
const UNKNOWN_AFTER_NS: Nanos = 2 * PERIOD_NS + 20_000_000;
const NEVER: Nanos = Nanos::MAX;

/// Sending machine.
pub(crate) struct SendingMachine {
    rng: Rng,
    faults: MachineFaults,
    /// Thinning factor of zones.
    send_interval: u64,
    max_datagram_len: usize,
    /// Clocks at the start, which differ from those of other machines.
    clocks: WallTimestamp,
    boot: u64,
    hub: ProcessState,
    gateway: ProcessState,
    sensors: [SimulatedSensor; 2],
    outgoing: Outgoing,
    epoch: u32,
    announce_at: Nanos,
    pub(crate) sent: SentDatagrams,
}

/// A program that is stopped and restarted.
struct ProcessState {
    is_running: bool,
    /// Time at which the program is stopped or started next.
    changes_at: Nanos,
}

struct SimulatedSensor {
    /// Number of the sensor, its position in the hub's configuration.
    number: u8,
    seq: u64,
    verdict: Verdict,
    scan_at: Nanos,
    unknown_at: Nanos,
    status_at: Nanos,
    /// State of the sensor's zones in the gateway.
    state: ZonesState,
}

/// Epoch, number of the sensor, and number of the topic.
pub(crate) type StreamKey = (u32, u8, u8);
/// Datagrams of a sample; `None` for a datagram that the kernel refused.
pub(crate) type DatagramParts = Vec<Option<Vec<u8>>>;

/// Everything that was sent.
#[derive(Default)]
pub(crate) struct SentDatagrams {
    /// Samples of each stream, by their sequence numbers.
    pub(crate) datagrams: BTreeMap<StreamKey, Vec<DatagramParts>>,
    /// Run of the hub in which the zones with this value in `nearest_mm` were published.
    pub(crate) boot_ids: Vec<u64>,
}

/// Connection from the gateway to the network.
struct Uplink<'a> {
    now: Nanos,
    rng: &'a mut Rng,
    refusal: f64,
    sent: &'a mut SentDatagrams,
    network: &'a mut Network,
}

impl Transmit for Uplink<'_> {
    fn transmit(&mut self, datagram: &[u8], _group: u8, _above: u8) -> bool {
        let head = Datagram::read(datagram).expect("a whole datagram").head;
        let numbers = self.sent.datagrams.entry((head.epoch, head.sensor, head.topic)).or_default();
        if head.part == 0 {
            assert_eq!(numbers.len(), head.sequence as usize, "numbers have no gaps");
            numbers.push(Vec::new());
        }
        let is_sent = self.rng.f64() >= self.refusal;
        let parts = numbers.last_mut().expect("the first part is sent first");
        assert_eq!(parts.len(), usize::from(head.part));
        parts.push(is_sent.then(|| datagram.to_vec()));
        if is_sent {
            self.network.send(self.now, datagram);
        }
        is_sent
    }
}

impl SendingMachine {
    /// Creates a machine that sends one of every `send_interval` samples of zones, in datagrams of at most
    /// `max_datagram_len` bytes.
    pub(crate) fn new(
        seed: u64,
        faults: MachineFaults,
        send_interval: u64,
        max_datagram_len: usize,
    ) -> SendingMachine {
        let mut rng = Rng::with_seed(seed);
        let clocks = WallTimestamp { monotonic_ns: rng.u64(1..1 << 50), wall_ns: rng.u64(1 << 60..1 << 61) };
        let epoch = 1_700_000_000;
        let mut sending = SendingMachine {
            faults,
            send_interval,
            clocks,
            boot: 0,
            hub: ProcessState { is_running: false, changes_at: 0 },
            gateway: ProcessState { is_running: false, changes_at: 0 },
            sensors: [0, 1].map(|number| SimulatedSensor::new(number, moment(clocks, 0))),
            outgoing: gateway(epoch, send_interval, max_datagram_len),
            max_datagram_len,
            epoch,
            announce_at: SECOND_NS,
            sent: SentDatagrams::default(),
            rng,
        };
        sending.switch_hub(0);
        sending.switch_gateway(0);
        sending
    }

    /// Ends all faults: starts the programs and sensors that are stopped.
    pub(crate) fn stop_faults(&mut self, now: Nanos) {
        self.faults = MachineFaults::default();
        for runs in [&mut self.hub, &mut self.gateway] {
            runs.changes_at = if runs.is_running { NEVER } else { now };
        }
        for sensor in &mut self.sensors {
            sensor.scan_at = sensor.scan_at.min(now + PERIOD_NS);
        }
    }

    /// Returns the time of the next event.
    pub(crate) fn next(&self, now: Nanos) -> Nanos {
        let restart_at = self.hub.changes_at.min(self.gateway.changes_at);
        let announce_at = if self.gateway.is_running { self.announce_at } else { NEVER };
        let of_sensors = self.sensors.iter().map(|sensor| {
            let left = sensor.state.time_left(moment(self.clocks, now)).filter(|_| self.gateway.is_running);
            let silence_at = left.map_or(NEVER, |left| now + left.as_nanos() as Nanos);
            let publish_at = sensor.scan_at.min(sensor.unknown_at).min(sensor.status_at);
            silence_at.min(if self.hub.is_running { publish_at } else { NEVER })
        });
        of_sensors.fold(restart_at.min(announce_at), Nanos::min)
    }

    /// Performs all actions that are due.
    pub(crate) fn step(&mut self, now: Nanos, network: &mut Network) {
        if now >= self.hub.changes_at {
            self.switch_hub(now);
        }
        if now >= self.gateway.changes_at {
            self.end_gateway(now, network);
            self.switch_gateway(now);
        }
        for position in 0..NAMES.len() {
            if self.hub.is_running {
                self.publish_due(position, now, network);
            }
            let moment = moment(self.clocks, now);
            if self.gateway.is_running
                && let Some(update) = self.sensors[position].state.silence(moment)
            {
                self.pass_to_gateway(position, None, PayloadRef::Zones(&update.zones), now, network);
            }
        }
        if self.gateway.is_running && now >= self.announce_at {
            self.announce_at = now + SECOND_NS;
            self.announce(now, network);
        }
    }

    /// Announces all sensors.
    pub(crate) fn announce(&mut self, now: Nanos, network: &mut Network) {
        let SendingMachine { rng, sent, outgoing, .. } = self;
        let mut uplink = Uplink { now, rng, refusal: self.faults.refusal, sent, network };
        outgoing.announce(stamp(self.clocks, now), &mut uplink);
    }

    fn switch_hub(&mut self, now: Nanos) {
        self.hub.is_running = !self.hub.is_running;
        if !self.hub.is_running {
            self.hub.changes_at = now + self.rng.u64(30_000_000..2 * SECOND_NS);
            return;
        }
        self.hub.changes_at =
            if self.faults.hub { now + self.rng.u64(SECOND_NS..9 * SECOND_NS) } else { NEVER };
        self.boot = self.rng.u64(1..);
        if self.faults.order && self.rng.bool() {
            self.sensors.iter_mut().for_each(|sensor| sensor.number ^= 1);
        }
        for sensor in &mut self.sensors {
            sensor.seq = 0;
            sensor.scan_at = now + self.rng.u64(1..PERIOD_NS);
            sensor.unknown_at = NEVER;
            sensor.status_at = now + self.rng.u64(1..SECOND_NS / 2);
        }
    }

    fn switch_gateway(&mut self, now: Nanos) {
        self.gateway.is_running = !self.gateway.is_running;
        if !self.gateway.is_running {
            self.gateway.changes_at = now + self.rng.u64(10_000_000..2 * SECOND_NS);
            return;
        }
        self.gateway.changes_at =
            if self.faults.gateway { now + self.rng.u64(SECOND_NS..9 * SECOND_NS) } else { NEVER };
        self.epoch += 1;
        self.outgoing = gateway(self.epoch, self.send_interval, self.max_datagram_len);
        self.announce_at = now + SECOND_NS;
        let moment = moment(self.clocks, now);
        self.sensors.iter_mut().for_each(|sensor| sensor.state = ZonesState::new(moment));
    }

    /// Ends the run of a gateway. In half of the cases, the gateway is killed. Otherwise, it sends a last announcement.
    fn end_gateway(&mut self, now: Nanos, network: &mut Network) {
        if self.gateway.is_running && self.rng.bool() {
            self.announce(now, network);
        }
    }

    /// Publishes the samples of a sensor that are due.
    fn publish_due(&mut self, position: usize, now: Nanos, network: &mut Network) {
        let SimulatedSensor { scan_at, unknown_at, status_at, .. } = self.sensors[position];
        if now >= scan_at {
            let silent_ns = if self.faults.silence && self.rng.u8(..) == 0 {
                self.rng.u64(PERIOD_NS..4 * SECOND_NS)
            } else {
                PERIOD_NS
            };
            if self.rng.u8(..) < 8 {
                let verdicts = [Verdict::Clear, Verdict::Clear, Verdict::Clear, Verdict::Slow, Verdict::Stop];
                self.sensors[position].verdict = verdicts[self.rng.usize(..verdicts.len())];
            }
            let sensor = &mut self.sensors[position];
            (sensor.scan_at, sensor.unknown_at) = (now + silent_ns, now + UNKNOWN_AFTER_NS);
            let verdict = sensor.verdict;
            self.publish_zones(position, verdict, now, network);
            self.sensors[position].seq += 1;
        } else if now >= unknown_at {
            self.sensors[position].unknown_at = NEVER;
            self.publish_zones(position, Verdict::Unknown, now, network);
        }
        if now >= status_at {
            self.sensors[position].status_at = now + SECOND_NS;
            let mut status = Status::default();
            status.set_sensor_type("LMS200");
            let header = self.header(position, now);
            self.pass_to_gateway(position, Some(&header), PayloadRef::Status(&status), now, network);
        }
    }

    fn publish_zones(&mut self, position: usize, verdict: Verdict, now: Nanos, network: &mut Network) {
        let zones = Zones {
            verdict: verdict as u8,
            invalid_beams: position as u16,
            nearest_mm: self.sent.boot_ids.len() as u32,
            ..Zones::unknown()
        };
        self.sent.boot_ids.push(self.boot);
        if self.gateway.is_running {
            let (header, moment) = (self.header(position, now), moment(self.clocks, now));
            let update = self.sensors[position].state.take(&header, &zones, 0, moment);
            self.pass_to_gateway(position, Some(&header), PayloadRef::Zones(&update.zones), now, network);
        }
    }

    fn header(&self, position: usize, now: Nanos) -> Header {
        let WallTimestamp { monotonic_ns, wall_ns } = stamp(self.clocks, now);
        let SimulatedSensor { number, seq, .. } = self.sensors[position];
        Header {
            seq,
            stamp_first_ns: monotonic_ns,
            stamp_last_ns: monotonic_ns,
            wall_ns,
            boot: self.boot,
            sensor: number,
            period_us: (PERIOD_NS / 1000) as u32,
            ..Header::default()
        }
    }

    /// Passes a sample to the gateway, if it runs.
    fn pass_to_gateway(
        &mut self,
        position: usize,
        header: Option<&Header>,
        payload: PayloadRef<'_>,
        now: Nanos,
        network: &mut Network,
    ) {
        if self.gateway.is_running {
            let SendingMachine { rng, sent, outgoing, .. } = self;
            let mut uplink = Uplink { now, rng, refusal: self.faults.refusal, sent, network };
            let sample = Sample { header, missed: 0, payload };
            outgoing.sample(position, &sample, stamp(self.clocks, now), &mut uplink);
        }
    }
}

impl SimulatedSensor {
    fn new(number: u8, now: Timestamp) -> SimulatedSensor {
        let state = ZonesState::new(now);
        let verdict = Verdict::Clear;
        SimulatedSensor {
            number,
            seq: 0,
            verdict,
            scan_at: NEVER,
            unknown_at: NEVER,
            status_at: NEVER,
            state,
        }
    }
}

fn gateway(epoch: u32, send_interval: u64, max_datagram_len: usize) -> Outgoing {
    let mut outgoing = Outgoing::new(HUB_ID, epoch, Form::Sealed, max_datagram_len);
    for name in NAMES {
        outgoing.follow(name, |topic| match topic {
            Topic::Zones => NonZeroU64::new(send_interval),
            Topic::Status => NonZeroU64::new(1),
            _ => None,
        });
    }
    outgoing
}

fn stamp(clocks: WallTimestamp, now: Nanos) -> WallTimestamp {
    WallTimestamp { monotonic_ns: clocks.monotonic_ns + now, wall_ns: clocks.wall_ns + now }
}

fn moment(clocks: WallTimestamp, now: Nanos) -> Timestamp {
    let monotonic_ns = clocks.monotonic_ns + now;
    Timestamp { monotonic_ns, boottime_ns: monotonic_ns }
}
