// The link for Python: the same state machine as in the daemon. Time in and out is integer nanoseconds of any one
// clock.
#include "pipefish/link.h"

#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>

#include <cstring>
#include <map>
#include <memory>
#include <new>
#include <string>

namespace nb = nanobind;

void bind_link(nb::module_ &m);

namespace
{

nb::bytes to_bytes(const void *data, size_t n)
{
    return nb::bytes(static_cast<const char *>(data), n);
}

const uint8_t *data_of(const nb::bytes &bytes)
{
    return reinterpret_cast<const uint8_t *>(bytes.c_str());
}

[[noreturn]] void fail(PyObject *type, const char *text)
{
    PyErr_SetString(type, text);
    throw nb::python_error();
}

// ValueError, BufferError (try later) and ConnectionError (no peer), with a sentence that says what was wrong.
void require(pf_status status, const char *wrong)
{
    if (status == PF_OK)
        return;
    if (status == PF_ERR_SPACE)
        fail(PyExc_BufferError, "the queue of the link is full; try again when it has drained");
    if (status == PF_ERR_CLOSED)
        fail(PyExc_ConnectionError, "the link has no peer");
    fail(PyExc_ValueError, wrong);
}

// An event with its bytes copied, so that it may be kept.
struct Event {
    pf_link_event raw;
    nb::bytes data;
};

std::string event_text(const Event &e)
{
    static const char *const names[] = {"?",      "UP",    "DOWN",   "INCOMPATIBLE", "CONTROL",
                                        "LATEST", "OFFER", "OBJECT", "SENT",         "REFUSED"};
    return std::string("<Event ") + names[e.raw.type <= PF_LINK_REFUSED ? e.raw.type : 0] + ", " +
           std::to_string(e.raw.size) + " bytes>";
}

class Link
{
public:
    explicit Link(const pf_link_config &config)
    {
        size_t n = pf_link_workspace_size(&config);
        if (n == 0)
            fail(PyExc_ValueError, "Link: role, nonce or a size is out of range (see pf_link_config)");
        workspace_.reset(static_cast<uint8_t *>(::operator new(n, std::align_val_t(16))));
        require(pf_link_init(&link_, &config, workspace_.get(), n), "Link: invalid configuration");
    }

    nb::list input(const nb::bytes &bytes, uint64_t now_ns)
    {
        nb::list events;
        take_events(events);
        size_t done = 0;
        do { // once without bytes, too: it notices silence
            done += pf_link_input(link_, data_of(bytes) + done, bytes.size() - done, now_ns);
            take_events(events);
        } while (done < bytes.size());
        return events;
    }

    nb::bytes output(size_t capacity, uint64_t now_ns)
    {
        if (capacity < PF_LINK_FRAME_MAX || capacity > (size_t(1) << 24))
            fail(PyExc_ValueError, "output: capacity must lie between 1072 (one frame) and 16777216 bytes");
        std::unique_ptr<uint8_t[]> out(new uint8_t[capacity]);
        return to_bytes(out.get(), pf_link_output(link_, out.get(), capacity, now_ns));
    }

    uint64_t deadline(uint64_t now_ns) const { return pf_link_deadline(link_, now_ns); }
    void reset(uint64_t now_ns) { pf_link_reset(link_, now_ns); }

    void send_control(const nb::bytes &bytes)
    {
        require(pf_link_send_control(link_, data_of(bytes), bytes.size()), "send_control: longer than max_control");
    }

    void send_latest(uint32_t topic, const nb::bytes &bytes)
    {
        require(pf_link_send_latest(link_, topic, data_of(bytes), bytes.size()),
                "send_latest: no such topic, or longer than max_latest");
    }

    void send_object(const nb::bytes &name, uint32_t kind, const nb::bytes &bytes)
    {
        require(pf_link_send_object(link_, name_of(name), kind, data_of(bytes), bytes.size()),
                "send_object: empty, kind above 255, or the name is under way already");
        lent_[key(name)] = bytes;
    }

    void cancel_object(const nb::bytes &name)
    {
        require(pf_link_cancel_object(link_, name_of(name)), "cancel_object: no such object is under way");
        lent_.erase(key(name));
    }

    void answer_object(uint32_t slot, uint32_t answer)
    {
        require(pf_link_answer_object(link_, slot, static_cast<pf_link_answer>(answer)),
                "answer_object: no such question is open, or not with this answer");
    }

    uint32_t free_send_slots() const { return pf_link_free_send_slots(link_); }
    bool is_up() const { return pf_link_is_up(link_); }
    nb::dict stats() const;

private:
    struct Release {
        void operator()(uint8_t *p) const { ::operator delete(p, std::align_val_t(16)); }
    };

    static std::string key(const nb::bytes &name) { return std::string(name.c_str(), name.size()); }

    static const uint8_t *name_of(const nb::bytes &name)
    {
        if (name.size() != PF_LINK_NAME_SIZE)
            fail(PyExc_ValueError, "the name of an object has 32 bytes");
        return data_of(name);
    }

    void take_events(nb::list &events)
    {
        Event event;
        while (pf_link_next_event(link_, &event.raw)) {
            event.data = to_bytes(event.raw.data, event.raw.data == nullptr ? 0 : event.raw.size);
            if (event.raw.type == PF_LINK_SENT || event.raw.type == PF_LINK_REFUSED)
                lent_.erase(std::string(reinterpret_cast<const char *>(event.raw.name), PF_LINK_NAME_SIZE));
            event.raw.data = nullptr;
            events.append(event);
        }
    }

    std::unique_ptr<uint8_t, Release> workspace_;
    pf_link *link_ = nullptr;
    std::map<std::string, nb::bytes> lent_; // keeps the objects under way alive
};

nb::dict Link::stats() const
{
    const pf_link_stats &s = *pf_link_get_stats(link_);
    nb::dict d;
    d["bytes_in"] = s.bytes_in;
    d["bytes_out"] = s.bytes_out;
    d["frames_in"] = s.frames_in;
    d["frames_out"] = s.frames_out;
    d["crc_errors"] = s.crc_errors;
    d["malformed"] = s.malformed;
    d["stale"] = s.stale;
    d["fragments_sent"] = s.fragments_sent;
    d["fragments_resent"] = s.fragments_resent;
    d["fragments_received"] = s.fragments_received;
    d["fragments_duplicate"] = s.fragments_duplicate;
    d["objects_sent"] = s.objects_sent;
    d["objects_received"] = s.objects_received;
    d["object_bytes_sent"] = s.object_bytes_sent;
    d["object_bytes_received"] = s.object_bytes_received;
    d["control_sent"] = s.control_sent;
    d["control_resent"] = s.control_resent;
    d["control_received"] = s.control_received;
    d["latest_sent"] = s.latest_sent;
    d["latest_replaced"] = s.latest_replaced;
    d["latest_received"] = s.latest_received;
    d["latest_incomplete"] = s.latest_incomplete;
    d["sessions"] = s.sessions;
    d["rtt_us"] = s.rtt_us;
    d["peer_clock_offset_ns"] = s.peer_clock_offset_ns;
    d["peer_clock_error_ns"] = s.peer_clock_error_ns;
    return d;
}

nb::bytes encode(const nb::bytes &bytes)
{
    std::unique_ptr<uint8_t[]> out(new uint8_t[bytes.size() + bytes.size() / 254 + 1]);
    return to_bytes(out.get(), pf_cobs_encode(data_of(bytes), bytes.size(), out.get()));
}

nb::bytes decode(const nb::bytes &bytes)
{
    std::unique_ptr<uint8_t[]> out(new uint8_t[bytes.size() + 1]);
    size_t n = 0;
    require(pf_cobs_decode(data_of(bytes), bytes.size(), out.get(), &n), "cobs_decode: no COBS code");
    return to_bytes(out.get(), n);
}

void bind_event(nb::module_ &m)
{
    nb::class_<Event>(m, "Event", "What the link has to tell; `type` (pf_link_event_type) says which fields are valid.")
        .def_prop_ro("type", [](const Event &e) { return e.raw.type; })
        .def_prop_ro("slot", [](const Event &e) { return e.raw.slot; })
        .def_prop_ro("kind", [](const Event &e) { return e.raw.kind; })
        .def_prop_ro("topic", [](const Event &e) { return e.raw.topic; })
        .def_prop_ro("size", [](const Event &e) { return e.raw.size; })
        .def_prop_ro(
            "data", [](const Event &e) { return e.data; }, "bytes; a copy")
        .def_prop_ro("name", [](const Event &e) { return to_bytes(e.raw.name, PF_LINK_NAME_SIZE); })
        .def_prop_ro("peer_role", [](const Event &e) { return e.raw.peer_role; })
        .def_prop_ro("peer_version", [](const Event &e) { return e.raw.peer_version; })
        .def_prop_ro("peer_schema", [](const Event &e) { return e.raw.peer_schema; })
        .def_prop_ro("peer_nonce", [](const Event &e) { return e.raw.peer_nonce; })
        .def_prop_ro("peer_boot_id", [](const Event &e) { return e.raw.peer_boot_id; })
        .def_prop_ro("peer_restarted", [](const Event &e) { return e.raw.peer_restarted; })
        .def("__repr__", &event_text);
}

} // namespace

void bind_link(nb::module_ &m)
{
    bind_event(m);
    nb::class_<Link>(
        m, "Link",
        "One end of the link between crawler and host (lib/link/SPEC.md): bytes and times in, bytes and events "
        "out. Zero means the default of pf_link_config.")
        .def(
            "__init__",
            [](Link *self, uint32_t role, uint32_t nonce, uint64_t boot_id, uint32_t schema, uint32_t max_object,
               uint32_t receive_slots, uint32_t send_slots, uint32_t max_fragment, uint32_t max_latest,
               uint32_t max_control, uint32_t control_queue, uint32_t window, uint32_t keepalive_ms,
               uint32_t rto_min_ms) {
                pf_link_config config = {};
                config.role = role;
                config.nonce = nonce;
                config.boot_id = boot_id;
                config.schema = schema;
                config.max_fragment = max_fragment;
                config.send_slots = send_slots;
                config.receive_slots = receive_slots;
                config.max_object = max_object;
                config.max_latest = max_latest;
                config.max_control = max_control;
                config.control_queue = control_queue;
                config.window = window;
                config.keepalive_ms = keepalive_ms;
                config.rto_min_ms = rto_min_ms;
                new (self) Link(config);
            },
            nb::kw_only(), nb::arg("role"), nb::arg("nonce"), nb::arg("boot_id") = 0, nb::arg("schema") = 1,
            nb::arg("max_object") = 0, nb::arg("receive_slots") = 0, nb::arg("send_slots") = 0,
            nb::arg("max_fragment") = 0, nb::arg("max_latest") = 0, nb::arg("max_control") = 0,
            nb::arg("control_queue") = 0, nb::arg("window") = 0, nb::arg("keepalive_ms") = 0, nb::arg("rto_min_ms") = 0,
            "role 1 device, 2 host; nonce: random, not 0, new at each start. ValueError: out of range.")
        .def("input", &Link::input, nb::arg("data"), nb::arg("now_ns"),
             "Takes bytes that were read (may be none); returns the list of events that wait, oldest first.")
        .def("output", &Link::output, nb::arg("capacity"), nb::arg("now_ns"),
             "At most `capacity` (>= 1072) bytes of whole frames to write now; empty = nothing. What is handed out "
             "cannot be overtaken by something more urgent.")
        .def("deadline", &Link::deadline, nb::arg("now_ns"),
             "When to call output, and input for its events, at the latest.")
        .def("reset", &Link::reset, nb::arg("now_ns"), "The stream broke: forget half a frame and say hello again.")
        .def("send_control", &Link::send_control, nb::arg("data"),
             "ValueError: too long. BufferError: queue full. ConnectionError: no peer.")
        .def("send_latest", &Link::send_latest, nb::arg("topic"), nb::arg("data"),
             "Replaces what waits under this topic. ValueError: too long. ConnectionError: no peer.")
        .def("send_object", &Link::send_object, nb::arg("name"), nb::arg("kind"), nb::arg("data"),
             "Starts an object named by the SHA-256 of its bytes; works without a peer. ValueError; BufferError: no "
             "slot.")
        .def("cancel_object", &Link::cancel_object, nb::arg("name"), "ValueError: not under way.")
        .def("answer_object", &Link::answer_object, nb::arg("slot"), nb::arg("answer"),
             "1 accept, 2 stored, 3 refuse, 4 again (pf_link_answer). ValueError: no such question is open.")
        .def("free_send_slots", &Link::free_send_slots)
        .def_prop_ro("is_up", &Link::is_up)
        .def_prop_ro("stats", &Link::stats, "dict of pf_link_stats");
    m.def("cobs_encode", &encode, nb::arg("data"), "COBS code of the bytes, without the delimiter.");
    m.def("cobs_decode", &decode, nb::arg("data"), "The bytes of a COBS code. ValueError: it is none.");
    m.def(
        "crc32c", [](const nb::bytes &data, uint32_t crc) { return pf_crc32c(crc, data_of(data), data.size()); },
        nb::arg("data"), nb::arg("crc") = 0, "CRC-32C of the bytes, continued from `crc`.");
}
