//! `seese3 import bag` in a build without the feature `bags`.

use std::ffi::OsString;

use clap::Args;

use crate::output::not_built;

#[derive(Debug, Args)]
pub struct BagPath {
    /// Ignored: the command needs a build with the feature `bags`
    #[arg(
        trailing_var_arg = true,
        allow_hyphen_values = true,
        value_name = "ARGUMENTS"
    )]
    _arguments: Vec<OsString>,
}

impl BagPath {
    #[expect(clippy::unused_async, reason = "as the command that is built")]
    pub async fn import(self) -> anyhow::Result<()> {
        Err(not_built("import bag", "bags"))
    }
}
