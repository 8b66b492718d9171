#include "pipefish/drivers/clock.h"
#include "pipefish/drivers/transport.h"
#include "unity.h"

#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <unistd.h>

static pf_transport line;
static char error[256];

void setUp(void) {}

void tearDown(void)
{
    if (line.self != NULL)
        line.ops->close(line.self);
    line.self = NULL;
}

static uint16_t port_of_name(void)
{
    return (uint16_t)atoi(strrchr(line.ops->name(line.self), ':') + 1);
}

static void open_listener(const char *address)
{
    pf_tcp_config config = {.address = address};
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_tcp_listen(&line, &config, error, sizeof error), error);
    TEST_ASSERT_TRUE(port_of_name() != 0);
}

static int connect_anything(void)
{
    struct sockaddr_in a = {.sin_family = AF_INET, .sin_port = htons(port_of_name())};
    a.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    int fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
    TEST_ASSERT_EQUAL_INT(0, connect(fd, (struct sockaddr *)&a, sizeof a));
    return fd;
}

/* As the link begins. */
static int connect_client(void)
{
    int fd = connect_anything();
    TEST_ASSERT_EQUAL_INT(1, write(fd, "", 1));
    return fd;
}

static void wait_readable(void)
{
    struct pollfd p = {line.ops->fd(line.self), POLLIN, 0};
    TEST_ASSERT_EQUAL_INT(1, poll(&p, 1, 60000));
}

static void expect_beginning(const pf_transport *t)
{
    uint8_t byte = 1;
    size_t n = 0;
    while (n == 0) {
        wait_readable();
        TEST_ASSERT_EQUAL_INT(PF_OK, t->ops->read(t->self, &byte, 1, &n));
    }
    TEST_ASSERT_EQUAL_UINT8(0, byte);
}

static void accept_client(void)
{
    bool fresh = false;
    wait_readable();
    TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->service(line.self, &fresh));
    TEST_ASSERT_TRUE(fresh);
    TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->service(line.self, &fresh));
    TEST_ASSERT_FALSE(fresh);
    expect_beginning(&line);
    line.ops->heard(line.self); /* a frame */
}

static void expect_read(const char *text)
{
    char buffer[64];
    size_t have = 0, n;
    while (have < strlen(text)) {
        wait_readable();
        TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->read(line.self, (uint8_t *)buffer + have, sizeof buffer - have, &n));
        have += n;
    }
    TEST_ASSERT_EQUAL_size_t(strlen(text), have);
    TEST_ASSERT_EQUAL_MEMORY(text, buffer, have);
}

/* Proves: bytes go both ways; a client that leaves is noticed, the next one starts a fresh stream. */
static void test_connect_disconnect_reconnect(void)
{
    uint8_t byte;
    size_t n;
    bool fresh;
    open_listener("127.0.0.1");
    TEST_ASSERT_EQUAL_INT(PF_ERR_AGAIN, line.ops->service(line.self, &fresh));
    TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, line.ops->read(line.self, &byte, 1, &n));
    TEST_ASSERT_EQUAL_size_t(0, line.ops->room(line.self));
    for (int round = 0; round < 3; round++) {
        char reply[8];
        int client = connect_client();
        accept_client();
        TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->read(line.self, &byte, 1, &n));
        TEST_ASSERT_EQUAL_size_t(0, n);
        TEST_ASSERT_EQUAL_INT(5, write(client, "hello", 5));
        expect_read("hello");
        TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->write(line.self, (const uint8_t *)"world", 5, &n));
        TEST_ASSERT_EQUAL_size_t(5, n);
        TEST_ASSERT_EQUAL_INT(5, recv(client, reply, 5, MSG_WAITALL));
        if (round == 1) { /* an abortive close: the driver must see a reset as an end too */
            struct linger hard = {1, 0};
            setsockopt(client, SOL_SOCKET, SO_LINGER, &hard, sizeof hard);
        }
        close(client);
        wait_readable();
        TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, line.ops->read(line.self, &byte, 1, &n));
        TEST_ASSERT_TRUE(line.ops->error(line.self)[0] != '\0');
        TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, line.ops->write(line.self, &byte, 1, &n));
    }
}

/* Closes a connection, and returns when the other end has been told. */
static void hang_up(int fd)
{
    struct tcp_info info = {0};
    socklen_t size = sizeof info;
    TEST_ASSERT_EQUAL_INT(0, shutdown(fd, SHUT_WR));
    for (int i = 0; i < 60000 && info.tcpi_state != TCP_FIN_WAIT2; i++) {
        TEST_ASSERT_EQUAL_INT(0, getsockopt(fd, IPPROTO_TCP, TCP_INFO, &info, &size));
        (void)usleep(1000);
    }
    TEST_ASSERT_EQUAL_INT(TCP_FIN_WAIT2, info.tcpi_state);
    close(fd);
}

static pf_transport take_visitor(void)
{
    pf_transport visitor = {NULL, NULL};
    bool fresh;
    wait_readable();
    TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->service(line.self, &fresh));
    TEST_ASSERT_FALSE(fresh);
    TEST_ASSERT_TRUE(line.ops->visitor(line.self, &visitor));
    TEST_ASSERT_FALSE(line.ops->visitor(line.self, &visitor));
    expect_beginning(&visitor);
    return visitor;
}

static void expect_bytes(const pf_transport *t, const char *bytes)
{
    uint8_t got[16];
    size_t n = 0, k, wanted = strlen(bytes);
    for (int i = 0; i < 60000 && n < wanted; i++, n += k) {
        TEST_ASSERT_EQUAL_INT(PF_OK, t->ops->read(t->self, got + n, sizeof got - n, &k));
        if (k == 0)
            (void)usleep(1000);
    }
    TEST_ASSERT_EQUAL_MEMORY(bytes, got, wanted);
}

/* Proves: others that come while a client has the line look on, three at most, each with a stream of its own, and the
 * first is undisturbed; when it has gone the next one has the line, after the first's last bytes. */
static void test_others_look_on(void)
{
    uint8_t byte;
    size_t n;
    bool fresh;
    pf_transport visitor[3];
    int client[3];
    open_listener("127.0.0.1");
    int first = connect_client();
    accept_client();
    for (int i = 0; i < 3; i++) {
        client[i] = connect_client();
        visitor[i] = take_visitor();
    }
    int fourth = connect_anything();
    wait_readable();
    TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->service(line.self, &fresh));
    TEST_ASSERT_EQUAL_INT(0, recv(fourth, &byte, 1, 0)); /* sent away */
    close(fourth);
    TEST_ASSERT_EQUAL_INT(6, write(client[1], "second", 6));
    TEST_ASSERT_EQUAL_INT(5, write(first, "first", 5));
    expect_read("first");
    expect_bytes(&visitor[1], "second");
    TEST_ASSERT_EQUAL_INT(PF_OK, visitor[2].ops->write(visitor[2].self, (const uint8_t *)"x", 1, &n));
    TEST_ASSERT_EQUAL_INT(1, recv(client[2], &byte, 1, 0));
    close(client[0]);
    for (int i = 0; i < 60000 && visitor[0].ops->read(visitor[0].self, &byte, 1, &n) == PF_OK; i++)
        (void)usleep(1000);
    TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, visitor[0].ops->service(visitor[0].self, &fresh));
    for (int i = 0; i < 3; i++)
        visitor[i].ops->close(visitor[i].self);

    TEST_ASSERT_EQUAL_INT(4, write(first, "last", 4));
    hang_up(first);
    int next = connect_client();
    TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->service(line.self, &fresh));
    TEST_ASSERT_FALSE(fresh);
    expect_read("last");
    TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, line.ops->read(line.self, &byte, 1, &n));
    accept_client();
    TEST_ASSERT_EQUAL_INT(4, write(next, "next", 4));
    expect_read("next");
    close(next);
    close(client[1]);
    close(client[2]);
}

static void expect_closed(const pf_transport *t)
{
    uint8_t byte;
    size_t n;
    pf_status status;
    do {
        wait_readable();
        status = t->ops->read(t->self, &byte, 1, &n);
        TEST_ASSERT_EQUAL_size_t(0, n);
    } while (status == PF_OK);
    TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, status);
}

/* Proves: what a page in a browser makes it send has neither the line nor a visitor's place, whatever follows. */
static void test_a_request_of_a_browser_is_closed(void)
{
    static const char request[] = "POST / HTTP/1.1\r\n\r\n\0\0";
    bool fresh = false;
    open_listener("127.0.0.1");
    int browser = connect_anything();
    TEST_ASSERT_EQUAL_INT(sizeof request, write(browser, request, sizeof request));
    wait_readable();
    TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->service(line.self, &fresh));
    expect_closed(&line);
    TEST_ASSERT_NOT_NULL(strstr(line.ops->error(line.self), "does not speak the link"));
    int host = connect_client();
    accept_client();
    int page = connect_anything();
    TEST_ASSERT_EQUAL_INT(4, write(page, "GET ", 4));
    pf_transport visitor = {NULL, NULL};
    wait_readable();
    TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->service(line.self, &fresh));
    TEST_ASSERT_TRUE(line.ops->visitor(line.self, &visitor));
    expect_closed(&visitor);
    close(page);
    close(host);
    close(browser);
}

/* Proves: a connection that a browser holds ready, and that says nothing, gives the line to the next that comes. */
static void test_a_connection_that_never_began_makes_room(void)
{
    bool fresh = false;
    open_listener("127.0.0.1");
    int idle = connect_anything();
    wait_readable();
    TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->service(line.self, &fresh));
    TEST_ASSERT_TRUE(fresh);
    (void)usleep(300000);
    int host = connect_client();
    accept_client();
    close(host);
    close(idle);
}

/* Proves: a client that is silent for too long loses the line to the next. */
static void test_a_silent_client_makes_room(void)
{
    pf_tcp_config config = {.address = "127.0.0.1", .silence_ms = 20};
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_tcp_listen(&line, &config, error, sizeof error));
    int silent = connect_client();
    accept_client();
    (void)usleep(30000);
    int next = connect_client();
    accept_client();
    TEST_ASSERT_EQUAL_INT(4, write(next, "next", 4));
    expect_read("next");
    close(next);
    close(silent);
}

/* Proves: bytes that are no frames keep the line for nobody; frames do. */
static void test_a_client_that_trickles_makes_room(void)
{
    pf_tcp_config config = {.address = "127.0.0.1", .silence_ms = 200};
    bool fresh = true;
    int late = -1;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_tcp_listen(&line, &config, error, sizeof error));
    int trickling = connect_client();
    accept_client();
    for (int i = 0; i < 30; i++) {
        TEST_ASSERT_EQUAL_INT(1, write(trickling, "x", 1));
        expect_read("x");
        (void)usleep(10000);
    }
    int next = connect_client();
    accept_client();
    for (int i = 0; i < 100 && fresh; i++) { /* again where the machine stood still for so long */
        (void)usleep(300000);
        uint64_t begin = pf_now();
        line.ops->heard(line.self);
        close(late);
        late = connect_anything();
        wait_readable();
        TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->service(line.self, &fresh));
        TEST_ASSERT_TRUE(!fresh || pf_now() - begin >= 200000000);
    }
    TEST_ASSERT_FALSE(fresh);
    close(late);
    close(next);
    close(trickling);
}

/* Proves: one that waits while no descriptor is free does not keep the daemon awake, and comes in when one is. */
static void test_who_cannot_be_taken_waits_without_waking_anybody(void)
{
    struct rlimit limit, none;
    struct pollfd p = {.events = POLLIN};
    bool fresh = false;
    open_listener("127.0.0.1");
    p.fd = line.ops->fd(line.self);
    int host = connect_client();
    TEST_ASSERT_EQUAL_INT(0, getrlimit(RLIMIT_NOFILE, &limit));
    none = limit;
    none.rlim_cur = 0;
    wait_readable();
    TEST_ASSERT_EQUAL_INT(0, setrlimit(RLIMIT_NOFILE, &none));
    pf_status status = line.ops->service(line.self, &fresh);
    TEST_ASSERT_EQUAL_INT(0, setrlimit(RLIMIT_NOFILE, &limit));
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, status);
    TEST_ASSERT_EQUAL_INT(0, poll(&p, 1, 0));
    for (int i = 0; i < 60000 && !fresh; i++) {
        (void)line.ops->service(line.self, &fresh);
        (void)usleep(1000);
    }
    TEST_ASSERT_TRUE(fresh);
    expect_beginning(&line);
    int next = connect_anything();
    wait_readable(); /* as before */
    close(next);
    close(host);
}

/* Proves: with a client that does not read, room falls to nothing instead of queueing without end, writing never
 * blocks, and every byte that was taken arrives. */
static void test_room_bounds_the_queue(void)
{
    static uint8_t bytes[65536];
    size_t n, room, total = 0, got = 0;
    open_listener("127.0.0.1");
    int client = connect_client();
    accept_client();
    TEST_ASSERT_TRUE(line.ops->room(line.self) >= 32768);
    /* What has reached the client's receive buffer no longer counts as queued: it fills first (some megabytes). */
    for (int idle = 0; idle < 50;) {
        room = line.ops->room(line.self);
        TEST_ASSERT_TRUE(room <= 65536);
        n = 0;
        if (room > 0)
            TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->write(line.self, bytes, room, &n));
        total += n;
        TEST_ASSERT_TRUE(total < 64u << 20);
        if (n == 0) {
            idle++;
            usleep(1000);
        } else {
            idle = 0;
        }
    }
    TEST_ASSERT_TRUE(line.ops->room(line.self) < 65536);
    while (got < total) {
        ssize_t k = recv(client, bytes, sizeof bytes, 0);
        TEST_ASSERT_TRUE(k > 0);
        got += (size_t)k;
    }
    close(client);
}

/* Proves: only loopback is listened on without encryption; what is no address is said to be none. */
static void test_other_addresses_are_refused(void)
{
    static const char *const others[] = {"0.0.0.0", "192.168.1.1", "128.0.0.1", "::", "fe80::1", "::ffff:127.0.0.1"};
    static const char *const no_addresses[] = {"", "localhost", "127.0.0", "127.0.0.1:80", NULL};
    for (size_t i = 0; i < sizeof others / sizeof others[0]; i++) {
        pf_tcp_config config = {.address = others[i]};
        TEST_ASSERT_EQUAL_INT_MESSAGE(PF_ERR_UNSUPPORTED, pf_tcp_listen(&line, &config, error, sizeof error),
                                      others[i]);
        TEST_ASSERT_NOT_NULL(strstr(error, "tls"));
        TEST_ASSERT_NOT_NULL(strstr(error, others[i]));
    }
    for (size_t i = 0; i < sizeof no_addresses / sizeof no_addresses[0]; i++) {
        pf_tcp_config config = {.address = no_addresses[i]};
        TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_tcp_listen(&line, &config, error, sizeof error));
    }
    TEST_ASSERT_NULL(line.self);
}

/* Proves: a port that is taken is an error with its address, and a port is free again at once after closing. */
static void test_taken_port(void)
{
    pf_transport second = {NULL, NULL};
    open_listener("127.0.0.1");
    pf_tcp_config config = {.address = "127.0.0.1", .port = port_of_name()};
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, pf_tcp_listen(&second, &config, error, sizeof error));
    TEST_ASSERT_NOT_NULL(strstr(error, line.ops->name(line.self)));
    int client = connect_client();
    accept_client();
    line.ops->close(line.self); /* the server closes first: its end lingers in TIME_WAIT */
    line.self = NULL;
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_tcp_listen(&line, &config, error, sizeof error), error);
    close(client);
}

/* Proves: IPv6's loopback works, and is named as people write it. */
static void test_ipv6(void)
{
    pf_tcp_config config = {.address = "::1"};
    pf_status status = pf_tcp_listen(&line, &config, error, sizeof error);
    if (status == PF_ERR_IO)
        TEST_IGNORE_MESSAGE("no IPv6 on this machine: not tested");
    TEST_ASSERT_EQUAL_INT(PF_OK, status);
    TEST_ASSERT_EQUAL_INT(0, strncmp(line.ops->name(line.self), "tcp [::1]:", 10));
    struct sockaddr_in6 a = {
        .sin6_family = AF_INET6, .sin6_port = htons(port_of_name()), .sin6_addr = in6addr_loopback};
    int fd = socket(AF_INET6, SOCK_STREAM | SOCK_CLOEXEC, 0);
    TEST_ASSERT_EQUAL_INT(0, connect(fd, (struct sockaddr *)&a, sizeof a));
    TEST_ASSERT_EQUAL_INT(1, write(fd, "", 1));
    accept_client();
    TEST_ASSERT_EQUAL_INT(2, write(fd, "v6", 2));
    expect_read("v6");
    close(fd);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_connect_disconnect_reconnect);
    RUN_TEST(test_others_look_on);
    RUN_TEST(test_a_request_of_a_browser_is_closed);
    RUN_TEST(test_a_connection_that_never_began_makes_room);
    RUN_TEST(test_a_silent_client_makes_room);
    RUN_TEST(test_a_client_that_trickles_makes_room);
    RUN_TEST(test_who_cannot_be_taken_waits_without_waking_anybody);
    RUN_TEST(test_room_bounds_the_queue);
    RUN_TEST(test_other_addresses_are_refused);
    RUN_TEST(test_taken_port);
    RUN_TEST(test_ipv6);
    return UNITY_END();
}
