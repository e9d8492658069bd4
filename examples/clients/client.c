/* A robot's side of `pcr-mpc serve` in C (POSIX, little-endian): cc client.c -o client && ./client 127.0.0.1 5005 */
#define _POSIX_C_SOURCE 200112L
#include <arpa/inet.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <time.h>

enum { N = 2, HEAD = 20, MEASUREMENT = HEAD + 8 * (2 + N) + 4, COMMAND = HEAD + 4 + 8 * (1 + 2 * N) + 4 };
static const double period = 0.01; /* s */

static uint32_t crc32(const unsigned char *data, int count)
{
    uint32_t crc = 0xffffffffu;
    for (int i = 0; i < count; i++) {
        crc ^= data[i];
        for (int bit = 0; bit < 8; bit++) crc = crc >> 1 ^ (crc & 1 ? 0xedb88320u : 0);
    }
    return ~crc;
}

static void head(unsigned char *to, int kind, uint32_t sequence, double stamp)
{
    memcpy(to, "PCR\1\1\0", 6);
    to[6] = (unsigned char)kind;
    to[7] = N;
    memcpy(to + 8, &sequence, 4);
    memcpy(to + 12, &stamp, 8);
}

int main(int count, char **words)
{
    const char *host = count > 1 ? words[1] : "127.0.0.1";
    double p[2] = {0.0, 0.25}, q[N] = {3.366835, -0.225243}, u[N] = {0.0}; /* your sensors; here a tip that stays */
    unsigned char out[MEASUREMENT], in[COMMAND + 1];
    struct sockaddr_in to = {0};
    to.sin_family = AF_INET;
    to.sin_port = htons((uint16_t)atoi(count > 2 ? words[2] : "5005"));
    const int wire = socket(AF_INET, SOCK_DGRAM, 0);
    const struct timeval patience = {0, 10000};
    const struct timespec rest = {0, 10000000};
    if (wire < 0 || inet_pton(AF_INET, host, &to.sin_addr) != 1 || connect(wire, (struct sockaddr *)&to, sizeof to)) return 1;
    setsockopt(wire, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
    for (uint32_t k = 0; k < 10; k++) {
        head(out, 1, k, period * k);
        memcpy(out + HEAD, p, sizeof p);
        memcpy(out + HEAD + sizeof p, q, sizeof q);
        uint32_t sum = crc32(out, MEASUREMENT - 4), sequence;
        memcpy(out + MEASUREMENT - 4, &sum, 4);
        send(wire, out, sizeof out, 0);
        long size; /* what comes late is of an older measurement */
        do { size = recv(wire, in, sizeof in, 0); } while (size == COMMAND && (memcpy(&sequence, in + 8, 4), sequence < k));
        if (size == COMMAND && (sum = crc32(in, COMMAND - 4), !memcmp(&sum, in + COMMAND - 4, 4))
            && !memcmp(in, "PCR\1\1\0\2", 7) && in[7] == N && (memcpy(&sequence, in + 8, 4), sequence == k)) {
            memcpy(u, in + HEAD + 4, sizeof u);
            printf("%u rung %d rates %g %g\n", (unsigned)k, in[HEAD], u[0], u[1]);
        } /* else: keep the last rates for a few periods, then stop by yourself */
        for (int i = 0; i < N; i++) q[i] += period * u[i];
        nanosleep(&rest, NULL);
    }
    return 0;
}
