//! Receives two sensors in tokio. Prints the number of beams of each scan, and a line if a sensor is silent for half a
//! second. Ctrl-C ends the program.

use std::time::Duration;

use futures::StreamExt;
use scanhub_client::{Error, Scan, Subscriber};
use tokio::task::JoinSet;
use tokio::time::timeout;

const SILENCE_TIMEOUT: Duration = Duration::from_millis(500);

async fn print_scans(sensor: &str) -> Result<(), Error> {
    let mut scans = Subscriber::<Scan>::builder(sensor).open_pollable()?;
    loop {
        // After a timeout, the future of `next` is dropped. Dropping it loses no scan.
        match timeout(SILENCE_TIMEOUT, scans.next()).await {
            Ok(Some(scan)) => println!("{sensor}: {} beams", scan?.beams()),
            Ok(None) => return Ok(()),
            Err(_) => println!("{sensor}: silent; there is a hub: {}", scans.hub_is_running()),
        }
    }
}

#[tokio::main]
pub(crate) async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut tasks = JoinSet::new();
    for sensor in ["front", "rear"] {
        tasks.spawn(print_scans(sensor));
    }
    tokio::select! {
        ended = tokio::signal::ctrl_c() => ended?,
        Some(ended) = tasks.join_next() => ended??,
    }
    println!("end");
    Ok(())
}
