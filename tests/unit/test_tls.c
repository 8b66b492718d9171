#include "pipefish/drivers/trust.h"
#include "temporary.h"
#include "unity.h"

#include <arpa/inet.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <openssl/ssl.h>
#include <sys/socket.h>

#define NEW_KEYS 100

static pf_trust *trust;
static pf_transport line;
static SSL_CTX *context;
static SSL *host;
static char error[256];

void setUp(void) {}

void tearDown(void)
{
    if (line.self != NULL)
        line.ops->close(line.self);
    line.self = NULL;
    SSL_free(host);
    SSL_CTX_free(context);
    pf_trust_close(trust);
    host = NULL;
    context = NULL;
    trust = NULL;
}

/* A host with a key of its own, which the device knows as an operator's. */
static void make_host(void)
{
    pf_trust *own = NULL;
    char pem[512];
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_trust_open(&own, temporary_path("host"), error, sizeof error), error);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_trust_set(trust, pf_trust_key(own), PF_ROLE_OPERATOR, "tester"));
    pf_trust_close(own);
    (void)snprintf(pem, sizeof pem, "%s/device.pem", temporary_path("host"));
    context = SSL_CTX_new(TLS_client_method());
    TEST_ASSERT_EQUAL_INT(1, SSL_CTX_use_certificate_file(context, pem, SSL_FILETYPE_PEM));
    TEST_ASSERT_EQUAL_INT(1, SSL_CTX_use_PrivateKey_file(context, pem, SSL_FILETYPE_PEM));
}

static void connect_host(void)
{
    struct sockaddr_in a = {.sin_family = AF_INET};
    a.sin_port = htons((uint16_t)atoi(strrchr(line.ops->name(line.self), ':') + 1));
    a.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    int fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
    TEST_ASSERT_EQUAL_INT(0, connect(fd, (struct sockaddr *)&a, sizeof a));
    TEST_ASSERT_EQUAL_INT(0, fcntl(fd, F_SETFL, O_NONBLOCK));
    host = SSL_new(context);
    TEST_ASSERT_EQUAL_INT(1, SSL_set_fd(host, fd));
    for (int i = 0; i < 60000; i++) {
        bool fresh = false;
        int done = SSL_connect(host);
        (void)line.ops->service(line.self, &fresh);
        if (fresh) {
            TEST_ASSERT_EQUAL_INT(1, done);
            return;
        }
        (void)usleep(1000);
    }
    TEST_FAIL_MESSAGE("the device does not let its host in");
}

/* Proves: a host, which may be one that only looks on, cannot hold the device in one call of read by sending new keys
 * for as long as it likes: each of them is a call, and others are served in between. */
static void test_new_keys_without_end_hold_nobody_up(void)
{
    pf_tls_config config = {.address = "127.0.0.1", .silence_ms = 60000};
    uint8_t byte;
    size_t n = 0;
    int calls = 0;
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_trust_open(&trust, temporary_path("device"), error, sizeof error), error);
    config.trust = trust;
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_tls_listen(&line, &config, error, sizeof error), error);
    make_host();
    connect_host();
    for (int i = 0; i < NEW_KEYS; i++) {
        TEST_ASSERT_EQUAL_INT(1, SSL_key_update(host, SSL_KEY_UPDATE_NOT_REQUESTED));
        TEST_ASSERT_EQUAL_INT(1, SSL_do_handshake(host));
    }
    TEST_ASSERT_EQUAL_INT(1, SSL_write(host, "x", 1));
    (void)usleep(100000); /* all of it waits in the device's socket; on a busy machine the last of it may not */
    while (n == 0 && calls < 60000) {
        if (calls > NEW_KEYS)
            (void)usleep(1000);
        TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->read(line.self, &byte, 1, &n));
        calls++;
    }
    TEST_ASSERT_EQUAL_UINT8('x', byte);
    TEST_ASSERT_GREATER_THAN_INT(NEW_KEYS, calls);
}

int main(void)
{
    UNITY_BEGIN();
    temporary_make();
    RUN_TEST(test_new_keys_without_end_hold_nobody_up);
    temporary_remove();
    return UNITY_END();
}
