//! How long the datagram of a scan is, for each variant of the sensor.

use schema::datagram::{HEAD, MTU_ETHERNET, MTU_SAFE, Packed};
use schema::{Contents, Scan, ScanHead};

use crate::support::figures::{Figure, Target};

/// Beams of 100 degrees at 1, 0.5 and 0.25 degrees, and of 180 at 1 and 0.5; and their names without upper bits and with.
const VARIANTS: [(usize, &str, &str); 5] = [
    (101, "size: 100/1", "size: 100/1, intensities"),
    (201, "size: 100/0.5", "size: 100/0.5, intensities"),
    (401, "size: 100/0.25", "size: 100/0.25, intensities"),
    (181, "size: 180/1", "size: 180/1, intensities"),
    (361, "size: 180/0.5", "size: 180/0.5, intensities"),
];

/// The lengths, with IP's and UDP's heads left out.
pub(crate) fn figures() -> Vec<Figure> {
    let variant = |(count, plain, full)| [figure(plain, count, 0), figure(full, count, Contents::UPPER)];
    VARIANTS.into_iter().flat_map(variant).collect()
}

fn figure(name: &'static str, count: usize, contents: u8) -> Figure {
    let scan = Scan::of(ScanHead { contents, ..ScanHead::default() }, &vec![0; count]);
    let len = scan.pack(&mut [0; MTU_ETHERNET]).map(|packed| HEAD + packed);
    let hub = len.map(|len| len as f64).into_iter().collect();
    Figure { name, unit: "B", hub, floor: Vec::new(), target: Target::Most(MTU_SAFE as f64) }
}
