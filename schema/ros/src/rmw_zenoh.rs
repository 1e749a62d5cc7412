//! Wire format of ROS 2 over Zenoh (`rmw_zenoh`), as text and bytes: keys of messages, tokens of nodes and publishers,
//! the quality of service, and attachments of messages. The sources for the format are docs/design.md,
//! `liveliness_utils.cpp` and `attachment_helpers.cpp` of `rmw_zenoh`.
//!
//! The attachment has the format of rmw_zenoh from 0.1.2 (Humble), 0.2.4 (Jazzy) and 0.6 (Kilted, Rolling) on. In
//! earlier versions, each value had its name before it.

use sha2::{Digest, Sha256};

use crate::Type;

/// A release of ROS 2. The wire format depends on the release.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Distro {
    /// Humble Hawksbill, which has no hashes of types.
    Humble,
    /// Jazzy Jalisco.
    Jazzy,
    /// Kilted Kaiju.
    Kilted,
    /// The development branch.
    Rolling,
}

impl Distro {
    /// All releases.
    pub const ALL: [Distro; 4] = [Distro::Humble, Distro::Jazzy, Distro::Kilted, Distro::Rolling];

    /// Returns the release's name in lower case.
    pub fn name(self) -> &'static str {
        match self {
            Distro::Humble => "humble",
            Distro::Jazzy => "jazzy",
            Distro::Kilted => "kilted",
            Distro::Rolling => "rolling",
        }
    }

    /// Returns the release called `name`, or `None` if no release has this name.
    pub fn parse(name: &str) -> Option<Distro> {
        Distro::ALL.into_iter().find(|distro| distro.name() == name)
    }

    /// Returns the hash of `message_type`, or the text that the release uses instead.
    pub fn hash(self, message_type: &Type) -> String {
        match self {
            Distro::Humble => "TypeHashNotSupported".to_owned(),
            Distro::Jazzy | Distro::Kilted | Distro::Rolling => message_type.hash(),
        }
    }
}

/// Quality of service that a publisher offers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Qos {
    /// Best effort, volatile, keep the last 5 messages: for sensor data.
    SensorData,
    /// Reliable, volatile, keep this number of last messages, at least one.
    Reliable(u8),
    /// Reliable, transient local, keep the last message, which late joiners receive.
    Latched,
}

impl Qos {
    /// Returns the number of messages in the history.
    pub fn depth(self) -> usize {
        match self {
            Qos::SensorData => 5,
            Qos::Reliable(depth) => depth.max(1).into(),
            Qos::Latched => 1,
        }
    }

    /// Returns the text in a token: reliability (2 best effort), durability (1 transient local), history and depth,
    /// deadline, lifespan, liveliness. Values that are the default are left out.
    pub fn text(self) -> String {
        match self {
            Qos::SensorData => "2::,5:,:,:,,".to_owned(),
            Qos::Reliable(depth) => format!("::,{depth}:,:,:,,"),
            Qos::Latched => ":1:,1:,:,:,,".to_owned(),
        }
    }
}

/// A node of ROS 2 that publishes.
#[derive(Clone, Debug)]
pub struct Node {
    /// `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// ID of the session, as Zenoh writes it.
    pub session: String,
    /// Namespace: empty, or names that each follow a slash.
    pub namespace: String,
    /// Name of the node: letters, digits and `_`.
    pub name: String,
    /// Release of the nodes that this node communicates with.
    pub distro: Distro,
}

/// A topic with one publisher.
#[derive(Clone, Debug)]
pub struct Publisher<'a> {
    /// Number of the publisher in its node, from 1. The node itself has the number 0.
    pub number: u32,
    /// Full name, such as `/front/scan`.
    pub topic: &'a str,
    /// Type of the messages.
    pub message_type: &'a Type,
    /// Quality of service.
    pub qos: Qos,
}

impl Node {
    /// Returns the token that announces the node.
    pub fn token(&self) -> String {
        let (domain, session, namespace, name) =
            (self.domain, &self.session, self.mangled_namespace(), &self.name);
        format!("@ros2_lv/{domain}/{session}/0/0/NN/%/{namespace}/{name}")
    }

    /// Returns the token that announces `publisher`.
    pub fn publisher_token(&self, publisher: &Publisher<'_>) -> String {
        let (domain, session, namespace, name) =
            (self.domain, &self.session, self.mangled_namespace(), &self.name);
        let (number, topic) = (publisher.number, publisher.topic.replace('/', "%"));
        let (type_name, hash, qos) = (
            publisher.message_type.dds_name(),
            self.distro.hash(publisher.message_type),
            publisher.qos.text(),
        );
        format!(
            "@ros2_lv/{domain}/{session}/0/{number}/MP/%/{namespace}/{name}/{topic}/{type_name}/{hash}/{qos}"
        )
    }

    /// Returns the key under which the messages of `publisher` are sent.
    pub fn key(&self, publisher: &Publisher<'_>) -> String {
        let (topic, type_name) = (publisher.topic.trim_matches('/'), publisher.message_type.dds_name());
        format!("{}/{topic}/{type_name}/{}", self.domain, self.distro.hash(publisher.message_type))
    }

    /// Returns the ID of `publisher` for the attachments of its messages. The ID stays the same as long as the token of
    /// `publisher` stays the same.
    pub fn gid(&self, publisher: &Publisher<'_>) -> [u8; 16] {
        let digest = Sha256::digest(self.publisher_token(publisher));
        std::array::from_fn(|i| digest[i])
    }

    /// Returns the key under which subscribers query the last message of a latched `publisher`. Used as a token, the
    /// key announces that subscribers can query the message. `AdvancedPublisher` of `zenoh-ext` does this for
    /// `rmw_zenoh`.
    pub fn history_key(&self, publisher: &Publisher<'_>) -> String {
        format!("{}/@adv/pub/{}/{}/_", self.key(publisher), self.session, publisher.number)
    }

    fn mangled_namespace(&self) -> String {
        if self.namespace.is_empty() { "%".to_owned() } else { self.namespace.replace('/', "%") }
    }
}

impl Type {
    /// Returns the name of the type in DDS: `sensor_msgs::msg::dds_::LaserScan_` for `sensor_msgs/msg/LaserScan`.
    fn dds_name(&self) -> String {
        let name = self.name.replace('/', "::");
        match name.rsplit_once("::") {
            Some((package, name)) => format!("{package}::dds_::{name}_"),
            None => name,
        }
    }
}

/// Size of an attachment in bytes.
pub const ATTACHMENT_LEN: usize = 33;

/// Returns the attachment of message `number` (from 1) of the publisher with ID `gid`, sent at `sent_ns` since 1970.
/// The attachment contains these two 64-bit numbers, little-endian, then the length of the ID in one byte, and the ID.
pub fn attachment(number: i64, sent_ns: i64, gid: [u8; 16]) -> [u8; ATTACHMENT_LEN] {
    let mut bytes = [0; ATTACHMENT_LEN];
    bytes[..8].copy_from_slice(&number.to_le_bytes());
    bytes[8..16].copy_from_slice(&sent_ns.to_le_bytes());
    bytes[16] = gid.len() as u8;
    bytes[17..].copy_from_slice(&gid);
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{LASER_SCAN, TF_MESSAGE};

    fn node() -> Node {
        let (session, name) = ("1f2e3d4c".to_owned(), "scanhub".to_owned());
        Node { domain: 7, session, namespace: String::new(), name, distro: Distro::Jazzy }
    }

    const SCAN: Publisher<'_> =
        Publisher { number: 3, topic: "/front/scan", message_type: &LASER_SCAN, qos: Qos::SensorData };

    #[test]
    fn keys_and_tokens_match_rmw_zenoh() {
        let hash = "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828";
        assert_eq!(node().key(&SCAN), format!("7/front/scan/sensor_msgs::msg::dds_::LaserScan_/{hash}"));
        assert_eq!(node().token(), "@ros2_lv/7/1f2e3d4c/0/0/NN/%/%/scanhub");
        assert_eq!(
            node().publisher_token(&SCAN),
            format!(
                "@ros2_lv/7/1f2e3d4c/0/3/MP/%/%/scanhub/%front%scan/sensor_msgs::msg::dds_::LaserScan_/{hash}/2::,5:,:,:,,"
            )
        );
    }

    #[test]
    fn tokens_have_a_namespace_and_may_lack_a_type_hash() {
        let node = Node { namespace: "/robot1/base".to_owned(), distro: Distro::Humble, ..node() };
        let latched =
            Publisher { number: 1, topic: "/tf_static", message_type: &TF_MESSAGE, qos: Qos::Latched };
        assert_eq!(node.token(), "@ros2_lv/7/1f2e3d4c/0/0/NN/%/%robot1%base/scanhub");
        assert_eq!(
            node.publisher_token(&latched),
            "@ros2_lv/7/1f2e3d4c/0/1/MP/%/%robot1%base/scanhub/%tf_static/tf2_msgs::msg::dds_::TFMessage_/\
             TypeHashNotSupported/:1:,1:,:,:,,"
        );
        assert_eq!(node.key(&latched), "7/tf_static/tf2_msgs::msg::dds_::TFMessage_/TypeHashNotSupported");
        assert_eq!(
            node.history_key(&latched),
            "7/tf_static/tf2_msgs::msg::dds_::TFMessage_/TypeHashNotSupported/@adv/pub/1f2e3d4c/1/_"
        );
        let other = Publisher { number: 2, ..latched.clone() };
        assert!(node.gid(&latched) == node.gid(&latched) && node.gid(&latched) != node.gid(&other));
        assert_eq!(Qos::Reliable(10).text(), "::,10:,:,:,,");
        for distro in Distro::ALL {
            assert_eq!(Distro::parse(distro.name()), Some(distro));
        }
    }

    #[test]
    fn attachment_has_number_time_and_publisher() {
        let bytes = attachment(258, -2, [9; 16]);
        assert_eq!(bytes[..8], [2, 1, 0, 0, 0, 0, 0, 0]);
        assert_eq!(bytes[8..16], [0xFE, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF]);
        assert_eq!((bytes[16], &bytes[17..]), (16, &[9; 16][..]));
    }
}
