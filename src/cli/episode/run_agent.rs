//! The agent of `wildcity episode run`.

use std::net::{TcpStream, ToSocketAddrs as _};
use std::time::{Duration, Instant};

use wildcity_alpasim::limits::DRIVER_START;
use wildcity_suite::{AGENTS, AgentChoice, BuiltIn, ExitCode};

use super::{bad_input, exit};

/// Prefix of an agent that is a driver of AlpaSim.
const EGODRIVER: &str = "egodriver:";

/// How long one attempt to connect may take, and the time between two.
const ATTEMPT: Duration = Duration::from_secs(2);
const RETRY: Duration = Duration::from_millis(200);

/// The agent that the command line or the suite names.
///
/// # Errors
/// It is empty, or has an invalid address of a driver; exit code 2.
pub(super) fn choice(agent: &str) -> anyhow::Result<AgentChoice> {
    if let Some(built_in) = BuiltIn::named(agent) {
        return Ok(AgentChoice::BuiltIn(built_in));
    }
    let line = match agent.strip_prefix(EGODRIVER) {
        // This program is the bridge. The address is an argument of its own in the shell.
        Some(address) => {
            check_address(address).map_err(|reason| {
                bad_input(format!(
                    "{agent:?} is not an agent: expected egodriver:HOST:PORT; {reason}"
                ))
            })?;
            let program = std::env::current_exe().map_err(bad_input)?;
            format!("'{}' alpasim drive --egodriver '{address}'", program.display())
        }
        None if agent.trim().is_empty() => {
            return Err(bad_input(format!("the agent is empty: an agent is {AGENTS}")));
        }
        None => agent.to_owned(),
    };
    Ok(AgentChoice::Command { name: agent.to_owned(), line })
}

/// Checks that an address is HOST:PORT, without characters that have a meaning in a shell.
fn check_address(address: &str) -> Result<(), &'static str> {
    // The address becomes a part of a shell's command line, within quotes.
    let is_allowed = |c: char| c.is_ascii_alphanumeric() || "-._:[]".contains(c);
    if !address.chars().all(is_allowed) {
        return Err("an address has only letters, digits and -._:[]");
    }
    let Some((host, port)) = address.rsplit_once(':') else { return Err("there is no port") };
    let is_ipv6 = host.starts_with('[') && host.ends_with(']');
    if host.is_empty() {
        return Err("there is no host");
    }
    if host.contains(':') && !is_ipv6 {
        return Err("an IPv6 address stands in brackets, as [::1]:7102");
    }
    match port.parse::<u16>() {
        Ok(1..) => Ok(()),
        _ => Err("a port is a number from 1 to 65535"),
    }
}

/// Waits until the driver of AlpaSim listens, if the agent is one. Otherwise the bridge of each
/// episode would wait for the same time, without a message.
///
/// # Errors
/// Nothing listens in the time that a driver may take to start; exit code 3.
pub(super) fn wait_for_driver(agent: &AgentChoice) -> anyhow::Result<()> {
    let Some(address) = agent.name().strip_prefix(EGODRIVER) else { return Ok(()) };
    let end = Instant::now() + DRIVER_START;
    let mut is_told = false;
    while let Err(error) = connect(address) {
        if !is_told {
            let seconds = DRIVER_START.as_secs();
            eprintln!("waiting for {address}, up to {seconds} s: {error}");
            is_told = true;
        }
        if Instant::now() >= end {
            let seconds = DRIVER_START.as_secs();
            let message = format!("no driver listens at {address} after {seconds} s: {error}");
            return Err(exit(ExitCode::Technical, message));
        }
        std::thread::sleep(RETRY);
    }
    Ok(())
}

/// Connects to any of the addresses of a host.
fn connect(address: &str) -> std::io::Result<()> {
    let mut last = std::io::Error::other("the host has no address");
    for socket in address.to_socket_addrs()? {
        match TcpStream::connect_timeout(&socket, ATTEMPT) {
            Ok(_) => return Ok(()),
            Err(error) => last = error,
        }
    }
    Err(last)
}
