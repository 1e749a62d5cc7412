//! `scanhub background` on the command line.

use std::io::stdin;
use std::path::PathBuf;

use clap::{Args, Subcommand};
use schema::Failure;
use verbs::{BackgroundOptions, ModelOrder, saved_model};

use super::Everywhere;

#[derive(Args, Debug)]
pub(crate) struct Background {
    /// The sensor
    sensor: String,
    #[command(subcommand)]
    order: Order,
}

#[derive(Clone, Debug, Subcommand)]
enum Order {
    /// How many beams are known; with --json every range
    Show,
    /// Forget it and learn it anew
    Reset,
    /// Keep it as it is: what stands there is not learned any more
    Freeze,
    /// Learn on
    Thaw,
    /// Write it to a file
    Save {
        /// The file; - is stdout
        file: PathBuf,
        /// Replace what is there
        #[arg(short, long)]
        force: bool,
    },
    /// Take a saved one for it
    Load {
        /// The file; - is stdin
        file: PathBuf,
        /// Also if it was saved from another sensor
        #[arg(long)]
        any_sensor: bool,
    },
}

impl Background {
    pub(crate) fn options(&self, everywhere: &Everywhere) -> Result<BackgroundOptions, Failure> {
        let order = match &self.order {
            Order::Show => ModelOrder::Show,
            Order::Reset => ModelOrder::Reset,
            Order::Freeze => ModelOrder::Freeze,
            Order::Thaw => ModelOrder::Thaw,
            Order::Save { file, force } => ModelOrder::Save { file: file.clone(), force: *force },
            Order::Load { file, any_sensor } => {
                let model = saved_model(file, &self.sensor, *any_sensor, &mut stdin())?;
                ModelOrder::Load(Box::new(model))
            }
        };
        Ok(BackgroundOptions {
            sensor: self.sensor.clone(),
            order,
            json: everywhere.json,
            places: everywhere.places()?,
        })
    }
}
