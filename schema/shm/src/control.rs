//! The control service: requests of clients and responses of the hub. One event wakes the hub, and another event wakes
//! clients. The crate `hub/daemon` handles requests.

use std::fmt::Debug;

use iceoryx2::active_request::ActiveRequest;
use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::{client, server};
use iceoryx2::prelude::ipc::Service as LocalService;
use iceoryx2::prelude::{AllocationStrategy, PortFactory as _};
use iceoryx2::service::port_factory::client::ClientCreateError;
use iceoryx2::service::port_factory::request_response;

use scanhub_schema::{CONTROL, CONTROL_REQUEST, CONTROL_RESPONSE, Failure, Kind, Request, Response, limits};

use crate::processes::Node;
use crate::resource_limits::{CONTROL_DESCRIPTORS, check_descriptors};
use crate::service::{OpenFailure, clients_full, create, name, open, port_failure};
use crate::wake::{Listener, Notifier, WakeService, create_listener, notifier, open_event, take_wakeups};

/// The hub's end of the control service. Each request wakes the listener [`requests`](Self::requests).
pub struct ControlServer {
    server: server::Server<LocalService, [u8], (), [u8], ()>,
    requests: Listener,
    responses: Notifier,
    control: ControlService,
    _events: [WakeService; 2],
}

/// A request that has no response yet. If it is dropped, the client gets no response.
pub struct IncomingRequest(ActiveRequest<LocalService, [u8], (), [u8], ()>);

/// A client's end of the control service.
pub struct ControlClient {
    client: client::Client<LocalService, [u8], (), [u8], ()>,
    requests: Notifier,
    responses: Listener,
    _control: ControlService,
    _events: [WakeService; 2],
}

/// A request that was sent. Dropping it cancels the request.
pub struct SentRequest(PendingResponse<LocalService, [u8], (), [u8], ()>);

type ControlService = request_response::PortFactory<LocalService, [u8], (), [u8], ()>;

impl ControlServer {
    /// Returns the hub's end of the service, which is created if it does not exist.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if memory or descriptors are short, or if another hub already serves the
    /// service, and [`Kind::Incompatible`] if the service has another layout.
    pub fn create(node: &Node) -> Result<ControlServer, Failure> {
        let service = name(CONTROL)?;
        let control = create(node, &service, || {
            let builder = node.service_builder(&service).request_response::<[u8], [u8]>();
            builder
                .max_servers(limits::MAX_PUBLISHERS)
                .max_clients(limits::MAX_CONTROL_CLIENTS)
                .max_nodes(limits::MAX_CONTROL_NODES)
                .max_active_requests_per_client(1)
                .max_loaned_requests(1)
                .max_response_buffer_size(1)
                .max_borrowed_responses_per_pending_response(1)
                .open_or_create()
                .map_err(OpenFailure::from)
        })?;
        let (request_event, response_event) =
            (create_event(node, CONTROL_REQUEST)?, create_event(node, CONTROL_RESPONSE)?);
        let server = control
            .server_builder()
            .initial_max_slice_len(Response::MAX_LEN)
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            .create()
            .map_err(|error| port_failure(&service, &error))?;
        let (requests, responses) = (create_listener(&request_event)?, notifier(&response_event, EVENT_ID)?);
        Ok(ControlServer { server, requests, responses, control, _events: [request_event, response_event] })
    }

    /// Returns the listener that each request wakes.
    pub fn requests(&self) -> &Listener {
        &self.requests
    }

    /// Returns the next request whose client still waits, or `None` if there is no request. Takes the pending wake-ups
    /// of the listener.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if the client cannot be connected.
    pub fn receive(&self) -> Result<Option<IncomingRequest>, Failure> {
        take_wakeups(&[&self.requests])?;
        let received = self.server.receive();
        received
            .map(|request| request.map(IncomingRequest))
            .map_err(|error| port_failure(self.control.name(), &error))
    }

    /// Sends `response` to the client of `request`, if the client still waits.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if the response cannot be sent.
    pub fn respond(&self, request: IncomingRequest, response: &Response) -> Result<(), Failure> {
        if !request.is_client_waiting() {
            return Ok(());
        }
        let bytes = response.encode();
        let unsent = |error: &dyn Debug| {
            Failure::new(
                Kind::ResourceExhausted,
                format!("cannot send a response to a client: {error:?}"),
                "",
            )
        };
        let loan = request.0.loan_slice_uninit(bytes.len()).map_err(|error| unsent(&error))?;
        loan.write_from_slice(&bytes).send().map_err(|error| unsent(&error))?;
        drop(request);
        self.responses.notify().map(drop).map_err(|error| unsent(&error))
    }
}

impl IncomingRequest {
    /// Returns the request, or `None` if it cannot be decoded.
    pub fn request(&self) -> Option<Request> {
        Request::decode(self.0.payload())
    }

    /// Returns whether the client still waits for the response.
    pub fn is_client_waiting(&self) -> bool {
        self.0.is_connected()
    }
}

impl ControlClient {
    /// Returns a client's end of the service, or `None` if no hub has created it yet.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if there are too many clients at once, or if descriptors are short.
    pub fn open(node: &Node) -> Result<Option<ControlClient>, Failure> {
        check_descriptors(CONTROL_DESCRIPTORS)?;
        let service = name(CONTROL)?;
        let builder = node.service_builder(&service).request_response::<[u8], [u8]>();
        let Some(control) = open(node, &service, builder.open())? else { return Ok(None) };
        let Some(request_event) = open_event(node, CONTROL_REQUEST)? else { return Ok(None) };
        let Some(response_event) = open_event(node, CONTROL_RESPONSE)? else { return Ok(None) };
        let (requests, responses) = (notifier(&request_event, EVENT_ID)?, create_listener(&response_event)?);
        let builder = control.client_builder().initial_max_slice_len(RESERVED_REQUEST_LEN);
        let builder = builder.allocation_strategy(AllocationStrategy::PowerOfTwo);
        let client = builder.create().map_err(|error| match error {
            ClientCreateError::ExceedsMaxSupportedClients => {
                clients_full(&service, limits::MAX_CONTROL_CLIENTS)
            }
            other => port_failure(&service, &other),
        })?;
        Ok(Some(ControlClient {
            client,
            requests,
            responses,
            _control: control,
            _events: [request_event, response_event],
        }))
    }

    /// Sends `request` and wakes the hub.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if the request cannot be sent, and [`Kind::NoHub`] if no hub receives it.
    pub fn send(&self, request: &Request) -> Result<SentRequest, Failure> {
        let unsent = |error: &dyn Debug| {
            Failure::new(
                Kind::ResourceExhausted,
                format!("cannot send a request to the hub: {error:?}"),
                "try again later",
            )
        };
        let bytes = request.encode();
        let loan = self.client.loan_slice_uninit(bytes.len()).map_err(|error| unsent(&error))?;
        let pending = loan.write_from_slice(&bytes).send().map_err(|error| unsent(&error))?;
        if pending.number_of_server_connections() == 0 {
            return Err(Failure::new(Kind::NoHub, "no hub accepts requests", "start one with `scanhub run`"));
        }
        self.requests.notify().map_err(|error| unsent(&error))?;
        Ok(SentRequest(pending))
    }

    /// Returns the listener that each response wakes, including responses to other clients.
    pub fn responses(&self) -> &Listener {
        &self.responses
    }
}

impl SentRequest {
    /// Returns the response, or `None` if it has not arrived.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`] if the response cannot be received or decoded.
    pub fn try_receive(&self) -> Result<Option<Response>, Failure> {
        let unreadable = |error: &dyn Debug| {
            Failure::new(Kind::Failed, format!("cannot read the hub's response: {error:?}"), "")
        };
        let Some(received) = self.0.receive().map_err(|error| unreadable(&error))? else { return Ok(None) };
        Response::decode(received.payload()).map(Some).ok_or_else(|| unreadable(&received.payload()))
    }

    /// Returns whether the hub still has the request: the hub runs, and has not dropped the request.
    pub fn is_open(&self) -> bool {
        self.0.is_connected()
    }
}

/// Returns an event of the control service, which is created if it does not exist.
fn create_event(node: &Node, service: &str) -> Result<WakeService, Failure> {
    let service = name(service)?;
    create(node, &service, || {
        let builder = node.service_builder(&service).event();
        builder
            .max_notifiers(limits::MAX_CONTROL_CLIENTS)
            .max_listeners(limits::MAX_CONTROL_CLIENTS)
            .max_nodes(limits::MAX_CONTROL_NODES)
            .event_id_max_value(EVENT_ID)
            .open_or_create()
            .map_err(OpenFailure::from)
    })
}

/// Number of bytes that are reserved for a request at first. Most requests have no model; the library allocates more
/// for those that have one.
const RESERVED_REQUEST_LEN: usize = 64;
/// ID of both events.
const EVENT_ID: usize = 1;
