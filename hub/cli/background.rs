//! `scanhub background` on the command line.

use std::io::stdin;
use std::path::PathBuf;

use clap::{Args, Subcommand};
use scanhub_schema::Failure;
use scanhub_verbs::{BackgroundOptions, ModelOrder, saved_model};

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
    /// Show how many beams are known; with --json, every range
    Show,
    /// Forget the model and learn it again
    Reset,
    /// Freeze the model: stop learning
    Freeze,
    /// Continue learning
    Thaw,
    /// Save the model to a file
    Save {
        /// The file; - is stdout
        file: PathBuf,
        /// Overwrite an existing file
        #[arg(short, long)]
        force: bool,
    },
    /// Load a saved model
    Load {
        /// The file; - is stdin
        file: PathBuf,
        /// Accept a model of another sensor
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
                ModelOrder::Load(model)
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
