//! The program of docs/first-program.md, which shows all lines below this comment. To run the program:
//! `cargo run --release -p scanhub-client --example first`.

use std::time::Duration;

use scanhub_client::{Error, Scan, Subscriber};

fn main() -> Result<(), Error> {
    let mut scans = Subscriber::<Scan>::builder("front").timeout(Duration::from_millis(500)).open()?;
    loop {
        let Some(scan) = scans.next()? else {
            let reason = scans.why_silent();
            println!("no scan for {:.1?}: {reason}; {}", scans.silent_for(), reason.remedy());
            continue;
        };
        if scan.missed > 0 || scan.restarted {
            println!("{} scans were missed; another hub: {}", scan.missed, scan.restarted);
        }
        let distances = (0..scan.beams()).filter_map(|i| Some((scan.distance_mm(i)?, i)));
        if let Some((mm, i)) = distances.min() {
            println!("{mm} mm at {} degrees", scan.angle_deg(i));
        }
    }
}
