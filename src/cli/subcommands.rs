//! Enums of subcommands.

/// An enum of subcommands, each of a type with a method `run`, which the enum's own `run` calls. Of
/// attributes, only `cfg` may stand before a subcommand: they apply to the call, too.
macro_rules! subcommands {
    ($name:ident; $($(#[$cfg:meta])* $command:ident($arguments:ty),)+) => {
        #[derive(Debug, clap::Subcommand)]
        enum $name {
            $($(#[$cfg])* $command($arguments),)+
        }

        impl $name {
            fn run(self) -> anyhow::Result<()> {
                match self {
                    $($(#[$cfg])* Self::$command(command) => command.run(),)+
                }
            }
        }
    };
}

pub(crate) use subcommands;
