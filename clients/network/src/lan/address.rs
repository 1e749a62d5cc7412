//! Names of samples in networks that deliver by name, such as Zenoh. A name is a path of hub, sensor and topic. A
//! sender may use any name, so each name is compared with the content of the datagram.

use std::fmt;

use scanhub_schema::datagram::{Announce, Datagram};
use scanhub_schema::{Topic, check_sensor};

use super::GatewayTable;

/// Name of a topic of a remote sensor: `scanhub/HUB/SENSOR/TOPIC`. HUB is 16 hex digits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Address<'a> {
    /// Number of the gateway.
    pub hub: u64,
    /// Name of the sensor.
    pub sensor: &'a str,
    /// Topic; `None` for announcements.
    pub topic: Option<Topic>,
}

/// First word of all names.
pub const PREFIX: &str = "scanhub";
/// Last word of the name of announcements.
pub const ANNOUNCE: &str = "announce";
/// Last word of the names that exist only as long as the hub or the sensor in the name.
pub const LIVE: &str = "@live";

impl<'a> Address<'a> {
    /// Parses a name. `None` if the name is not valid.
    pub fn parse(text: &'a str) -> Option<Address<'a>> {
        let (hub, sensor, last) = split_name(text)?;
        let topic = if last == ANNOUNCE { None } else { Some(Topic::parse(last)?) };
        Some(Address { hub, sensor, topic })
    }

    /// Returns whether `datagram` may be sent under this name. Its hub and topic must be those in the name. Its sensor
    /// number must have been announced for the sensor in the name, or not announced yet.
    pub fn is_of(&self, datagram: &Datagram<'_>, gateways: &GatewayTable) -> bool {
        let head = &datagram.head;
        let number = self.topic.map_or(Announce::NUMBER, Topic::number);
        if (head.hub, head.topic) != (self.hub, number) {
            return false;
        }
        match self.topic {
            None => {
                Announce::unpack(datagram.payload).is_none_or(|announced| announced.sensor() == self.sensor)
            }
            Some(_) => gateways
                .announced(head.hub, head.epoch, head.sensor)
                .is_none_or(|known| known.sensor() == self.sensor),
        }
    }
}

impl fmt::Display for Address<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let topic = self.topic.map_or(ANNOUNCE, Topic::name);
        write!(f, "{PREFIX}/{:016x}/{}/{topic}", self.hub, self.sensor)
    }
}

/// Parses `scanhub/HUB/SENSOR/@live`, a name that exists only as long as the sensor. Returns hub and sensor.
pub fn parse_live(text: &str) -> Option<(u64, &str)> {
    let (hub, sensor, last) = split_name(text)?;
    (last == LIVE).then_some((hub, sensor))
}

/// Returns hub, sensor and last word of a name. `None` if the name has another form.
fn split_name(text: &str) -> Option<(u64, &str, &str)> {
    let mut words = text.split('/');
    let (prefix, hub) = (words.next()?, words.next()?);
    let (sensor, last) = (words.next()?, words.next()?);
    let is_hub = hub.len() == 16 && hub.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'));
    let is_ours = prefix == PREFIX && is_hub && words.next().is_none() && check_sensor(sensor).is_ok();
    Some((u64::from_str_radix(hub, 16).ok().filter(|_| is_ours)?, sensor, last))
}

#[cfg(test)]
mod tests {
    use scanhub_schema::Zones;
    use scanhub_schema::datagram::{DatagramPayload, HEADER_LEN, Head};

    use super::*;
    use crate::lan::WallTimestamp;
    use crate::lan::incoming::Incoming;

    #[test]
    fn names_round_trip() {
        let scan = Address { hub: 0xab, sensor: "front", topic: Some(Topic::Scan) };
        let text = "scanhub/00000000000000ab/front/scan";
        assert_eq!((scan.to_string().as_str(), Address::parse(text)), (text, Some(scan)));
        let announce = Address { topic: None, ..scan };
        assert_eq!(Address::parse(&announce.to_string()), Some(announce));
        assert_eq!(parse_live("scanhub/00000000000000ab/front/@live"), Some((0xab, "front")));
        for other in [
            "scanhub/00000000000000AB/front/scan",
            "scanhub/ab/front/scan",
            "scanhub/+0000000000000ab/front/scan",
            "scanhub/00000000000000ab/front/scam",
            "scanhub/00000000000000ab/Front/scan",
            "scanhub/00000000000000ab/robot/scan",
            "scanhub/00000000000000ab/front/scan/more",
            "other/00000000000000ab/front/scan",
            "scanhub/00000000000000ab/front",
            "scanhub//front/scan",
            "",
        ] {
            assert!(Address::parse(other).is_none() && parse_live(other).is_none(), "{other}");
        }
    }

    #[test]
    fn datagrams_are_compared_with_their_name() {
        let sealed = |head: Head, pack: &dyn Fn(&mut [u8]) -> Option<usize>| {
            let mut buffer = [0; 400];
            let len = pack(&mut buffer[HEADER_LEN..]).unwrap();
            head.seal(&mut buffer, len).unwrap().to_vec()
        };
        let zones = |hub, sensor| {
            let topic = Topic::Zones.number();
            let head = Head { topic, hub, sensor, epoch: 1, revision: 1, ..Head::default() };
            sealed(head, &|room| Zones::unknown().pack(room))
        };
        let head = Head { hub: 5, epoch: 1, sensor: 2, revision: 1, ..Head::default() };
        let announced = sealed(head, &|room| Announce::new(1, "front", "").pack(room));
        let mut incoming = Incoming::new(&Topic::ALL);
        let may = |incoming: &Incoming, name: &str, bytes: &[u8]| {
            Address::parse(name).unwrap().is_of(&Datagram::read(bytes).unwrap(), incoming.gateways())
        };
        let (front, rear) = ("scanhub/0000000000000005/front/zones", "scanhub/0000000000000005/rear/zones");
        assert!(may(&incoming, rear, &zones(5, 2)), "no sensor was announced yet");
        assert!(!may(&incoming, "scanhub/0000000000000005/rear/announce", &announced));
        assert!(may(&incoming, "scanhub/0000000000000005/front/announce", &announced));
        incoming.receive(&announced, 0, WallTimestamp::default(), &mut Vec::new());
        assert!(may(&incoming, front, &zones(5, 2)) && !may(&incoming, rear, &zones(5, 2)));
        assert!(!may(&incoming, front, &zones(6, 2)), "another hub");
        assert!(!may(&incoming, "scanhub/0000000000000005/front/scan", &zones(5, 2)), "another topic");
    }
}
