//! Prints the nearest beam of every scan: `cargo run --example nearest front`.

use scanhub_client::{Error, Scan, subscribe};

fn main() -> Result<(), Error> {
    let sensor = std::env::args().nth(1).unwrap_or_else(|| "front".into());
    let mut scans = subscribe::<Scan>(&sensor)?;
    while let Some(scan) = scans.next()? {
        let distances = (0..scan.beams()).filter_map(|i| Some((scan.distance_mm(i)?, i)));
        if let Some((mm, i)) = distances.min() {
            println!("{mm} mm at {} degrees", scan.angle_deg(i));
        }
    }
    Ok(())
}
