//! Recording of two sensors in simulated rooms with people. A hub in virtual time publishes the topics, and all samples
//! are written to a file.

#[path = "virtual_hub.rs"]
pub(crate) mod virtual_hub;

use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;

use scanhub_config::{Config, Sources};
use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::{MIRROR_PERIOD, Mode, Unit, Variant};
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::file::Writer;
use scanhub_schema::{Background, Foreground, Header, Marks, Nanos, Scan, Topic, Zones};
use scanhub_shm::Domain;
use scanhub_shm::{Node, Payload, Subscriber};
use scanhub_sim::room::Room;
use scanhub_sim::world::World;

/// Names of the sensors, and their worlds.
pub(crate) const SENSORS: [(&str, &str); 2] = [("front", "fig8"), ("rear", "demo")];
/// Setting with which the hub learns the background after 40 scans, within the recording.
pub(crate) const SHORT_LEARNING: &str = "background.scans=40";

/// Returns the time from the start of a scan to the start of the next one, in nanoseconds.
pub(crate) fn scan_period() -> Nanos {
    Variant::HALF.revolutions() * MIRROR_PERIOD
}

/// Drives a hub in `domain` in virtual time. Each sensor sends a telegram with its mode and then `scans` scans. Writes
/// each sample that the hub publishes to `file`, and passes it to `keep` with the index of the sensor. Just before the
/// scan with the index `silence`, no sensor sends a byte for a second.
pub(crate) fn record(
    domain: &Domain,
    file: &Path,
    scans: u64,
    silence: Option<u64>,
    mut keep: impl FnMut(usize, PublishedSample),
) {
    let sources = Sources {
        files: Vec::new(),
        links: SENSORS.map(|(name, _)| format!("{name}=file:nothing")).to_vec(),
        set: ["link.front.mode=1", "link.rear.mode=1", SHORT_LEARNING].map(str::to_owned).to_vec(),
    };
    let config = Config::load(&sources).expect("the configuration is valid");
    let rooms =
        SENSORS.map(|(_, name)| Room::new(&name.parse::<World>().expect("the name of a built-in world"), 7));
    let mut writer =
        Writer::begin(File::create(file).expect("the recording can be created"), "", BTreeMap::new())
            .expect("the recording can be started");
    let driven = virtual_hub::virtual_hub(&config, domain, |links| {
        let node = scanhub_shm::client_node(domain).expect("a node");
        let subscribers = SENSORS.map(|(name, _)| Subscribers::attach(&node, name));
        for scan in 0..=scans {
            for (number, room) in rooms.iter().enumerate() {
                let silent_ns = if silence.is_some_and(|silence| scan >= silence) { ONE_SECOND } else { 0 };
                let at = ONE_SECOND + number as u64 * 9_000_000 + scan * scan_period() + silent_ns;
                let telegram = if scan == 0 {
                    lms::reply::configuration_reply(0, Mode(1), Unit::Mm, 0x10)
                } else {
                    let look = room.labeled_scan(Variant::HALF, Unit::Mm, Mode(1), at);
                    lms::measured::encode(0, Unit::Mm, &look.words, 0x10)
                };
                links[number].read(at, telegram.bytes());
                // Skip samples that the hub publishes at the start, because they do not belong to a telegram.
                let is_of_one = |sample: &PublishedSample| scan > 0 || sample.header.hub_time_ns().is_some();
                for sample in subscribers[number].take().into_iter().filter(is_of_one) {
                    let (name, _) = SENSORS[number];
                    writer
                        .write_sample(name, sample.topic, &sample.header, &sample.payload)
                        .expect("the recording can be written");
                    keep(number, sample);
                }
            }
            if scan % 4 == 0 {
                writer.close_chunk().expect("the recording can be written");
            }
        }
    });
    assert_eq!(driven, Ok(()));
    writer.finish().expect("the recording can be finished");
}

/// A sample with the header and the packed payload with which it was published.
#[derive(Debug, PartialEq)]
pub(crate) struct PublishedSample {
    pub(crate) topic: Topic,
    pub(crate) header: Header,
    pub(crate) payload: Vec<u8>,
}

/// Subscribers to the telegrams of a sensor and to the topics that are computed from them.
pub(crate) struct Subscribers {
    telegram: Subscriber<[u8]>,
    scan: Subscriber<Scan>,
    marks: Subscriber<Marks>,
    zones: Subscriber<Zones>,
    foreground: Subscriber<Foreground>,
    background: Subscriber<Background>,
}

impl Subscribers {
    /// Attaches to the topics of `sensor`.
    pub(crate) fn attach(node: &Node, sensor: &str) -> Subscribers {
        Subscribers {
            telegram: attach::<[u8]>(node, sensor),
            scan: attach::<Scan>(node, sensor),
            marks: attach::<Marks>(node, sensor),
            zones: attach::<Zones>(node, sensor),
            foreground: attach::<Foreground>(node, sensor),
            background: attach::<Background>(node, sensor),
        }
    }

    /// Returns the samples that have arrived since the last call, topic by topic.
    pub(crate) fn take(&self) -> Vec<PublishedSample> {
        let mut taken = Vec::new();
        drain::<[u8]>(&self.telegram, &mut taken, |telegram| telegram.to_vec());
        drain::<Scan>(&self.scan, &mut taken, packed);
        drain::<Marks>(&self.marks, &mut taken, packed);
        drain::<Zones>(&self.zones, &mut taken, packed);
        drain::<Foreground>(&self.foreground, &mut taken, packed);
        drain::<Background>(&self.background, &mut taken, packed);
        taken
    }
}

fn attach<P: Payload + ?Sized>(node: &Node, sensor: &str) -> Subscriber<P> {
    let service =
        P::open(node, sensor).expect("the topic can be opened").expect("the hub has created the topic");
    P::subscriber(node, &service).expect("the topic has a free slot")
}

fn drain<P: Payload + ?Sized>(
    from: &Subscriber<P>,
    to: &mut Vec<PublishedSample>,
    bytes: impl Fn(&P) -> Vec<u8>,
) {
    while let Some(sample) = P::receive(from).expect("samples can be received") {
        to.push(PublishedSample {
            topic: P::TOPIC,
            header: *sample.user_header(),
            payload: bytes(P::read(&sample)),
        });
    }
}

fn packed(payload: &(impl DatagramPayload + ?Sized)) -> Vec<u8> {
    let mut room = vec![0; 4096];
    let len = payload.pack(&mut room).expect("the payload fits into the buffer");
    room.truncate(len);
    room
}

const ONE_SECOND: Nanos = 1_000 * scanhub_schema::MILLIS;
