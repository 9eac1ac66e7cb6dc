//! WebSocket and HTTP.
