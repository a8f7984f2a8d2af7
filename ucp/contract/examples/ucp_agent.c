/*
 * An agent of the Uniform Chain Protocol (UCP) in one file of C11, written from ucp/contract/CONTRACT.md alone.
 *
 *     cc -O2 -Wall -Wextra -Werror -o ucp_agent ucp_agent.c -lm
 *     cc -O2 -DSECURED -o ucp_agent ucp_agent.c -lm -lcrypto      the same with keys: ucp_secured.c, on OpenSSL
 *     ucp_agent MISSION_FILE      one agent, over UDP
 *     ucp_agent --virtual         agents in virtual time, inputs and outputs as lines
 *
 * The 20 algorithms stand in order in section 6. Above them is what they need (bytes, hashes, JSON, the mission,
 * blocks, messages), below what drives them (inputs, trace, export, store, control socket, virtual time).
 * It has every feature but `telemetry` and `quirks`, for which it ends with status 127, and so it does for `secured`
 * and `sealed` if it was compiled without keys.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <math.h>
#include <poll.h>
#include <signal.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <sys/socket.h>
#include <sys/signalfd.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

enum {
    STATUS_WRONG = 2, STATUS_LACKS = 127,               /* exit statuses, beside 0 and 1 */
    MAX_MISSION = 4 << 20, MAX_BUNDLE = 8 << 20, MAX_REQUEST = 65536, MAX_VIRTUAL = 64 << 20, MAX_DEPTH = 512,
    HEADER = 14, MAX_DATAGRAM = 1472, BLOCK_HEADER = 12, EVENT_HEADER = 11, MAX_EVENT_DATA = 1024,
    MAX_CLIENTS = 64, AGENT_IDS = 65536, ROOT = 1
};

/* ================================================================================================================
 * 1  Bytes: growing buffers, big-endian numbers, hex, base64
 * ============================================================================================================= */

typedef struct { uint8_t *data; size_t len, cap; } Buf;

static void *grow(void *old, size_t size) {
    void *memory = realloc(old, size);
    if (memory == NULL) {
        fprintf(stderr, "no memory\n");
        abort();
    }
    return memory;
}

static uint8_t *buf_room(Buf *b, size_t n) {            /* room for n more bytes; returns where they go */
    if (b->cap - b->len < n) {
        b->cap = b->cap * 2 > b->len + n ? b->cap * 2 : b->len + n + 64;
        b->data = grow(b->data, b->cap);
    }
    return b->data + b->len;
}

static void put(Buf *b, const void *bytes, size_t n) {
    if (n > 0) {
        memcpy(buf_room(b, n), bytes, n);
        b->len += n;
    }
}

static void put_text(Buf *b, const char *text) { put(b, text, strlen(text)); }

static void put_byte(Buf *b, uint8_t byte) { put(b, &byte, 1); }

__attribute__((format(printf, 2, 3))) static void put_format(Buf *b, const char *format, ...) {
    char text[1024];
    va_list values;
    va_start(values, format);
    int n = vsnprintf(text, sizeof text, format, values);
    va_end(values);
    put(b, text, n < (int)sizeof text ? (size_t)n : sizeof text - 1);
}

static void buf_drop(Buf *b, size_t n) {                /* the first n bytes away */
    memmove(b->data, b->data + n, b->len - n);
    b->len -= n;
}

static void write_be(uint8_t *to, uint64_t value, int bytes) {
    for (int i = bytes - 1; i >= 0; i--, value >>= 8)
        to[i] = (uint8_t)value;
}

static uint64_t read_be(const uint8_t *from, int bytes) {
    uint64_t value = 0;
    for (int i = 0; i < bytes; i++)
        value = value << 8 | from[i];
    return value;
}

static void put_be(Buf *b, uint64_t value, int bytes) {
    write_be(buf_room(b, (size_t)bytes), value, bytes);
    b->len += (size_t)bytes;
}

static void put_hex(Buf *b, const uint8_t *bytes, size_t n) {
    uint8_t *to = buf_room(b, 2 * n);
    for (size_t i = 0; i < n; i++) {
        *to++ = (uint8_t)"0123456789abcdef"[bytes[i] >> 4];
        *to++ = (uint8_t)"0123456789abcdef"[bytes[i] & 15];
    }
    b->len += 2 * n;
}

static const char BASE64[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

static void put_base64(Buf *b, const uint8_t *bytes, size_t n) {
    uint8_t *to = buf_room(b, (n + 2) / 3 * 4);
    for (size_t i = 0; i < n; i += 3) {
        uint32_t v = (uint32_t)bytes[i] << 16 | (i + 1 < n ? (uint32_t)bytes[i + 1] << 8 : 0)
                   | (i + 2 < n ? bytes[i + 2] : 0);
        *to++ = (uint8_t)BASE64[v >> 18];
        *to++ = (uint8_t)BASE64[v >> 12 & 63];
        *to++ = i + 1 < n ? (uint8_t)BASE64[v >> 6 & 63] : '=';
        *to++ = i + 2 < n ? (uint8_t)BASE64[v & 63] : '=';
    }
    b->len += (n + 2) / 3 * 4;
}

static bool from_base64(Buf *out, const char *text, size_t n) {   /* padded, nothing but the standard alphabet */
    static uint8_t value[256];                          /* 1..64: a digit's value and one; 0: no digit */
    if (value['A'] == 0)
        for (int i = 0; i < 64; i++)
            value[(uint8_t)BASE64[i]] = (uint8_t)(i + 1);
    if (n % 4 != 0) return false;
    for (size_t i = 0; i < n; i += 4) {
        uint32_t v = 0;
        int pad = i + 4 < n ? 0 : text[i + 2] == '=' && text[i + 3] == '=' ? 2 : text[i + 3] == '=' ? 1 : 0;
        for (int k = 0; k < 4; k++) {
            uint8_t digit = k < 4 - pad ? value[(uint8_t)text[i + (size_t)k]] : 1;
            if (digit == 0) return false;
            v = v << 6 | (uint32_t)(digit - 1);
        }
        uint8_t bytes[3] = {(uint8_t)(v >> 16), (uint8_t)(v >> 8), (uint8_t)v};
        put(out, bytes, 3 - (size_t)pad);
    }
    return true;
}

/* ================================================================================================================
 * 2  H: SHA-256 (FIPS 180-4)
 * ============================================================================================================= */

typedef struct { uint8_t b[32]; } Hash;

static bool same(const Hash *x, const Hash *y) { return memcmp(x->b, y->b, 32) == 0; }

static const uint32_t SHA_K[64] = {
    0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5,
    0xd807aa98, 0x12835b01, 0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174,
    0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f, 0x4a7484aa, 0x5cb0a9dc, 0x76f988da,
    0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967,
    0x27b70a85, 0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85,
    0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070,
    0x19a4c116, 0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3,
    0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2};

#define ROTATE(x, n) ((x) >> (n) | (x) << (32 - (n)))

static void sha256_chunk(uint32_t state[8], const uint8_t *chunk) {
    uint32_t w[64], s[8];
    for (int i = 0; i < 16; i++)
        w[i] = (uint32_t)chunk[4 * i] << 24 | (uint32_t)chunk[4 * i + 1] << 16
             | (uint32_t)chunk[4 * i + 2] << 8 | chunk[4 * i + 3];
    for (int i = 16; i < 64; i++)
        w[i] = w[i - 16] + w[i - 7] + (ROTATE(w[i - 15], 7) ^ ROTATE(w[i - 15], 18) ^ w[i - 15] >> 3)
             + (ROTATE(w[i - 2], 17) ^ ROTATE(w[i - 2], 19) ^ w[i - 2] >> 10);
    memcpy(s, state, sizeof s);
    for (int i = 0; i < 64; i++) {
        uint32_t t1 = s[7] + (ROTATE(s[4], 6) ^ ROTATE(s[4], 11) ^ ROTATE(s[4], 25))
                    + ((s[4] & s[5]) ^ (~s[4] & s[6])) + SHA_K[i] + w[i];
        uint32_t t2 = (ROTATE(s[0], 2) ^ ROTATE(s[0], 13) ^ ROTATE(s[0], 22))
                    + ((s[0] & s[1]) ^ (s[0] & s[2]) ^ (s[1] & s[2]));
        memmove(s + 1, s, 7 * sizeof s[0]);
        s[4] += t1;
        s[0] = t1 + t2;
    }
    for (int i = 0; i < 8; i++)
        state[i] += s[i];
}

static Hash H(const uint8_t *bytes, size_t n) {
    uint32_t state[8] = {0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a,
                         0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
    uint8_t last[128] = {0};
    size_t whole = n / 64 * 64, rest = n - whole, size = rest < 56 ? 64 : 128;
    for (size_t i = 0; i < whole; i += 64)
        sha256_chunk(state, bytes + i);
    if (rest > 0)
        memcpy(last, bytes + whole, rest);
    last[rest] = 0x80;
    write_be(last + size - 8, (uint64_t)n * 8, 8);
    for (size_t i = 0; i < size; i += 64)
        sha256_chunk(state, last + i);
    Hash hash;
    for (int i = 0; i < 8; i++)
        write_be(hash.b + 4 * i, state[i], 4);
    return hash;
}

static Hash H_chain(const Hash *below, const Hash *block) {   /* CH_n = H(CH_(n-1) || BH_n) */
    uint8_t both[64];
    memcpy(both, below->b, 32);
    memcpy(both + 32, block->b, 32);
    return H(both, 64);
}

/* ================================================================================================================
 * 3  JSON: a strict reader into a flat list of nodes over the text, and what is written again from it
 * ============================================================================================================= */

/* Nodes are in the order of the text; `end` is the index behind a node's last descendant, so that the children of
   node i are i + 1, node[i + 1].end, ... until node[i].end; those of an object are keys and values in turn. */
typedef struct { char kind; uint32_t end; size_t at, len; } Node;   /* kind: { [ " 0 t f n; strings without quotes */
typedef struct { const char *text; size_t len, at; Node *node; size_t n, cap; Buf scratch; } Json;

static bool json_word(Json *j, const char *word) {
    size_t n = strlen(word);
    if (j->len - j->at < n || memcmp(j->text + j->at, word, n) != 0) return false;
    j->at += n;
    return true;
}

static char json_peek(Json *j) {                        /* the next character that is not white space, or 0 */
    while (j->at < j->len && memchr(" \t\n\r", j->text[j->at], 4) != NULL)
        j->at++;
    return j->at < j->len ? j->text[j->at] : '\0';
}

static size_t utf8_length(const uint8_t *s, size_t n) {   /* of the character at s, 0 if there is none */
    size_t size = s[0] < 0x80 ? 1 : s[0] < 0xc2 ? 0 : s[0] < 0xe0 ? 2 : s[0] < 0xf0 ? 3 : s[0] < 0xf5 ? 4 : 0;
    if (size > n || (size > 2 && ((s[0] == 0xe0 && s[1] < 0xa0) || (s[0] == 0xed && s[1] > 0x9f)
                                  || (s[0] == 0xf0 && s[1] < 0x90) || (s[0] == 0xf4 && s[1] > 0x8f))))
        return 0;
    for (size_t i = 1; i < size; i++)
        if ((s[i] & 0xc0) != 0x80) return 0;
    return size;
}

static int hex_digit(char c) {
    return c >= '0' && c <= '9' ? c - '0' : c >= 'a' && c <= 'f' ? c - 'a' + 10 : c >= 'A' && c <= 'F' ? c - 'A' + 10
         : -1;
}

static uint32_t four_hex(const char *s) {
    return (uint32_t)(hex_digit(s[0]) << 12 | hex_digit(s[1]) << 8 | hex_digit(s[2]) << 4 | hex_digit(s[3]));
}

static uint32_t json_escape(const Json *j, size_t from) {   /* of \uXXXX there; if none, more than any has */
    const char *s = j->text + j->at + from;
    if (j->len - j->at < from + 6 || s[0] != '\\' || s[1] != 'u') return UINT32_MAX;
    for (int i = 2; i < 6; i++)
        if (hex_digit(s[i]) < 0) return UINT32_MAX;
    return four_hex(s + 2);
}

static bool json_string(Json *j) {                      /* from behind the opening quote to behind the closing one */
    while (j->at < j->len) {
        uint8_t c = (uint8_t)j->text[j->at];
        if (c == '"') return j->at++, true;
        if (c < 0x20) return false;
        if (c != '\\') {
            size_t size = c < 0x80 ? 1 : utf8_length((const uint8_t *)j->text + j->at, j->len - j->at);
            if (size == 0) return false;
            j->at += size;
            continue;
        }
        if (j->len - j->at < 2 || memchr("\"\\/bfnrtu", j->text[j->at + 1], 9) == NULL) return false;
        if (j->text[j->at + 1] == 'u') {
            uint32_t high = json_escape(j, 0), low = high < 0xd800 || high > 0xdbff ? 0xdc00 : json_escape(j, 6);
            if (high > 0xffff || (high >= 0xdc00 && high <= 0xdfff) || low < 0xdc00 || low > 0xdfff) return false;
            j->at += high < 0xd800 || high > 0xdbff ? 4 : 10;
        }
        j->at += 2;
    }
    return false;
}

static bool json_digits(Json *j) {
    size_t from = j->at;
    while (j->at < j->len && j->text[j->at] >= '0' && j->text[j->at] <= '9')
        j->at++;
    return j->at > from;
}

static bool json_number(Json *j) {
    json_word(j, "-");
    if (!json_word(j, "0") && !json_digits(j)) return false;
    if (json_word(j, ".") && !json_digits(j)) return false;
    if (json_word(j, "e") || json_word(j, "E")) {
        if (!json_word(j, "+"))
            json_word(j, "-");
        return json_digits(j);
    }
    return true;
}

static bool json_value(Json *j, int depth) {
    char c = json_peek(j);
    if (j->n == j->cap) {
        j->cap = j->cap * 2 + 64;
        j->node = grow(j->node, j->cap * sizeof *j->node);
    }
    size_t me = j->n++, from = j->at + (c == '"');
    bool good = depth < MAX_DEPTH;
    j->node[me].kind = c == '-' || (c >= '0' && c <= '9') ? '0' : c;
    if (!good) return false;
    if (c == '{' || c == '[') {
        char close = c == '{' ? '}' : ']';
        j->at++;
        if (json_peek(j) != close) {
            do {
                if (c == '{') {
                    if (json_peek(j) != '"' || !json_value(j, depth + 1) || json_peek(j) != ':') return false;
                    j->at++;
                }
                if (!json_value(j, depth + 1)) return false;
            } while (json_peek(j) == ',' && j->at++ < j->len);
        }
        good = json_peek(j) == close && j->at++ < j->len;
    } else if (c == '"') {
        j->at++;
        good = json_string(j);
    } else {
        good = c == 't' ? json_word(j, "true") : c == 'f' ? json_word(j, "false") : c == 'n' ? json_word(j, "null")
             : json_number(j);
    }
    j->node[me].at = from;
    j->node[me].len = j->at - from - (c == '"');
    j->node[me].end = (uint32_t)j->n;
    return good;
}

/* The text must be followed by a NUL (of which numbers are read), and stay as long as the nodes are used. */
static bool json_parse(Json *j, const char *text, size_t len) {
    j->text = text;
    j->len = len;
    j->at = 0;
    if (j->node == NULL)
        j->node = grow(NULL, (j->cap = 256) * sizeof *j->node);
    j->node[0] = (Node){'\0', 1, 0, 0};                 /* node 0 is "none": it has no kind and no members */
    j->n = ROOT;
    return json_value(j, 0) && json_peek(j) == '\0' && j->at == len;
}

static char kind(const Json *j, uint32_t i) { return j->node[i].kind; }

static void put_utf8(Buf *b, uint32_t c) {
    int more = c < 0x80 ? 0 : c < 0x800 ? 1 : c < 0x10000 ? 2 : 3;      /* bytes behind the first */
    put_byte(b, (uint8_t)((more > 0 ? 0xf00 >> (more + 1) : 0) | c >> 6 * more));
    while (more-- > 0)
        put_byte(b, (uint8_t)(0x80 | (c >> 6 * more & 63)));
}

/* What a string says; good until the next call. Mostly there is no escape in it, and nothing is copied. */
static const char *json_text(Json *j, uint32_t i, size_t *len) {
    const char *s = j->text + j->node[i].at, *stop = s + j->node[i].len;
    *len = j->node[i].len;
    if (*len == 0 || memchr(s, '\\', *len) == NULL) return s;
    j->scratch.len = 0;
    while (s < stop) {
        if (*s != '\\') {
            put_byte(&j->scratch, (uint8_t)*s++);
        } else if (s[1] == 'u') {
            uint32_t c = four_hex(s + 2);
            s += 6;
            if (c >= 0xd800 && c < 0xdc00 && stop - s >= 6 && s[0] == '\\' && s[1] == 'u'
                && four_hex(s + 2) >= 0xdc00 && four_hex(s + 2) < 0xe000) {
                c = 0x10000 + ((c - 0xd800) << 10) + (four_hex(s + 2) - 0xdc00);
                s += 6;
            }
            put_utf8(&j->scratch, c);
        } else {
            static const char from[] = "\"\\/bfnrt", to[] = "\"\\/\b\f\n\r\t";
            put_byte(&j->scratch, (uint8_t)to[strchr(from, s[1]) - from]);
            s += 2;
        }
    }
    *len = j->scratch.len;
    return (const char *)j->scratch.data;
}

static bool says(Json *j, uint32_t i, const char *text) {
    size_t n;
    if (kind(j, i) != '"') return false;
    const char *s = json_text(j, i, &n);
    return n == strlen(text) && memcmp(s, text, n) == 0;
}

static uint32_t member(Json *j, uint32_t object, const char *key) {   /* 0 if there is none; of equal keys the last */
    uint32_t found = 0;
    if (kind(j, object) == '{')
        for (uint32_t i = object + 1; i < j->node[object].end; i = j->node[i + 1].end)
            if (says(j, i, key))
                found = i + 1;
    return found;
}

static bool json_uint(const Json *j, uint32_t i, uint64_t lowest, uint64_t highest, uint64_t *value) {
    if (kind(j, i) != '0') return false;
    const char *s = j->text + j->node[i].at;
    size_t n = j->node[i].len;
    *value = 0;
    for (size_t k = n == 2 && s[0] == '-' && s[1] == '0' ? 1 : 0; k < n; k++) {   /* -0 is 0 */
        if (s[k] < '0' || s[k] > '9') return false;
        uint64_t digit = (uint64_t)(s[k] - '0');
        if (*value > (UINT64_MAX - digit) / 10) return false;
        *value = *value * 10 + digit;
    }
    return *value >= lowest && *value <= highest;
}

static bool json_double(const Json *j, uint32_t i, double *value) {
    if (kind(j, i) != '0') return false;
    *value = strtod(j->text + j->node[i].at, NULL);
    return isfinite(*value);
}

static bool json_bytes(Json *j, uint32_t i, Buf *out) {   /* base64 */
    size_t n;
    out->len = 0;
    if (kind(j, i) != '"') return false;
    const char *text = json_text(j, i, &n);
    return from_base64(out, text, n);
}

/* Text of JSON again, in ASCII. */
static void put_ascii(Buf *b, const uint8_t *s, size_t n) {
    for (size_t size; n > 0; s += size, n -= size) {
        size = utf8_length(s, n);
        if (size == 1) {
            put_byte(b, s[0]);
            continue;
        }
        uint32_t c = s[0] & (0xffu >> (size + 1));
        for (size_t i = 1; i < size; i++)
            c = c << 6 | (s[i] & 63);
        if (c < 0x10000)
            put_format(b, "\\u%04x", c);
        else
            put_format(b, "\\u%04x\\u%04x", 0xd7c0 + (c >> 10), 0xdc00 + (c & 0x3ff));
    }
}

/* An object again, in ASCII and on one line, without the member of that name. */
static void put_object(Buf *b, Json *j, uint32_t object, const char *without) {
    const char *comma = "{";
    for (uint32_t i = object + 1; i < j->node[object].end; i = j->node[i + 1].end) {
        if (without != NULL && says(j, i, without)) continue;
        const Node *key = &j->node[i], *value = key + 1;
        put_text(b, comma);
        size_t from = key->at - 1, to = value->at + value->len + (value->kind == '"');
        put_ascii(b, (const uint8_t *)j->text + from, to - from);
        comma = ",";
    }
    put_text(b, comma[0] == '{' ? "{}" : "}");
}

/* ================================================================================================================
 * 4  The mission file
 * ============================================================================================================= */

typedef struct {
    double vote_timeout, phase1_timeout, phase2_timeout, phase3_timeout, finalize_gap;
    uint64_t max_block_bytes, max_event_bytes;
    bool vote_names_chain, changed_before_tally, asks_after_commit, top_needs_majority, phase1_tie_pop, phase2_tie_block;
    double answer_spread;                               /* 0: answers do not wait */
} Settings;

typedef struct {
    uint16_t agent_id, port;
    uint16_t *roster;
    size_t roster_len;
    Buf initial_data;
    struct in_addr address, broadcast;
    bool random_events, has_epoch;
    double mean_s, speedup;
    Settings settings;
    uint64_t seed, epoch_us;
    char *store;                                        /* NULL: keep nothing */
    char *bundle;                                       /* the file with its keys; NULL: the mission is not secured */
} Mission;

typedef struct { int status; char text[160]; } Fault;   /* what is wrong, in one sentence of ASCII without quotes */

__attribute__((format(printf, 3, 4))) static bool fail(Fault *fault, int status, const char *format, ...) {
    va_list values;
    va_start(values, format);
    vsnprintf(fault->text, sizeof fault->text, format, values);
    va_end(values);
    for (char *c = fault->text; *c != '\0'; c++)
        if (*c < ' ' || *c > '~' || *c == '"' || *c == '\\')
            *c = '?';
    fault->status = status;
    return false;
}

static bool is_sealed(const Buf *data) {                /* a depot's key of 32 bytes ends it */
    static const char tag[] = "UCP depot key";
    size_t n = sizeof tag - 1 + 32;
    return data->len >= n && memcmp(data->data + data->len - n, tag, sizeof tag - 1) == 0;
}

/* Features come before all values: one that is lacking may be the reason why a value is not known. */
static bool mission_features(Json *j, uint32_t root, bool sealed, Fault *fault) {
    static const char *const has[] = {"store", "vote_names_chain", "changed_before_tally", "asks_after_commit",
                                      "top_needs_majority", "phase1_tie=pop", "phase2_tie=block",
                                      "answer_spread_s",
#ifdef SECURED
                                      "secured", "sealed",
#endif
    };
    uint32_t list = member(j, root, "features"), quirks = member(j, root, "quirks");
    if (list != 0 && kind(j, list) != '[') return fail(fault, STATUS_WRONG, "features is no list of strings.");
    for (uint32_t i = list + 1; list != 0 && i < j->node[list].end; i = j->node[i].end) {
        bool known = false;
        if (kind(j, i) != '"') return fail(fault, STATUS_WRONG, "features is no list of strings.");
        for (size_t k = 0; k < sizeof has / sizeof *has; k++)
            known = known || says(j, i, has[k]);
        if (!known) {
            size_t n;
            const char *name = json_text(j, i, &n);
            return fail(fault, STATUS_LACKS, "This agent does not have the feature '%.*s'.", (int)(n < 80 ? n : 80),
                        name);
        }
    }
#ifdef SECURED
    (void)sealed;
#else
    if (sealed)
        return fail(fault, STATUS_LACKS, "This agent does not have the feature 'sealed'.");
    uint32_t security = member(j, root, "security");
    if (security != 0 && kind(j, security) != 'n')
        return fail(fault, STATUS_LACKS, "This agent does not have the feature 'secured'.");
#endif
    if (says(j, member(j, member(j, root, "events"), "source"), "mavlink"))
        return fail(fault, STATUS_LACKS, "This agent does not have the feature 'telemetry'.");
    if (quirks != 0 && kind(j, quirks) != '{') return fail(fault, STATUS_WRONG, "quirks is no object.");
    for (uint32_t i = quirks + 1; quirks != 0 && i < j->node[quirks].end; i = j->node[i + 1].end) {
        double value = 0;
        bool none = kind(j, i + 1) == 'f' || (json_double(j, i + 1, &value) && value == 0);
        if (!none)
            return fail(fault, STATUS_LACKS, "This agent does not have the feature 'quirks'.");
    }
    return true;
}

static bool mission_settings(Json *j, uint32_t object, Settings *s, Fault *fault) {
    *s = (Settings){10.0, 5.0, 5.0, 5.0, 0.1, 1024, 267, false, false, false, false, false, false,
                      0.0};
    if (object != 0 && kind(j, object) != '{') return fail(fault, STATUS_WRONG, "settings is no object.");
    struct { const char *key; double *value; bool zero; } numbers[] = {
        {"vote_timeout_s", &s->vote_timeout, false}, {"phase1_timeout_s", &s->phase1_timeout, false},
        {"phase2_timeout_s", &s->phase2_timeout, false}, {"phase3_timeout_s", &s->phase3_timeout, false},
        {"finalize_gap_s", &s->finalize_gap, true}, {"answer_spread_s", &s->answer_spread, true}};
    struct { const char *key; uint64_t *value; } sizes[] = {
        {"max_block_bytes", &s->max_block_bytes}, {"max_event_bytes", &s->max_event_bytes}};
    struct { const char *key; bool *value; } switches[] = {
        {"vote_names_chain", &s->vote_names_chain}, {"changed_before_tally", &s->changed_before_tally},
        {"asks_after_commit", &s->asks_after_commit}, {"top_needs_majority", &s->top_needs_majority}};
    struct { const char *key, *usual, *other; bool *value; } choices[] = {
        {"phase1_tie", "phase2", "pop", &s->phase1_tie_pop}, {"phase2_tie", "oldest", "block", &s->phase2_tie_block}};
    for (uint32_t i = 0, at; object != 0 && i < 6; i++)
        if ((at = member(j, object, numbers[i].key)) != 0
            && (!json_double(j, at, numbers[i].value) || *numbers[i].value < 0 || *numbers[i].value > 1e9
                || (*numbers[i].value == 0 && !numbers[i].zero)))
            return fail(fault, STATUS_WRONG, "The setting %s is out of range.", numbers[i].key);
    for (uint32_t i = 0, at; object != 0 && i < 4; i++)
        if ((at = member(j, object, switches[i].key)) != 0) {
            if (kind(j, at) != 't' && kind(j, at) != 'f')
                return fail(fault, STATUS_WRONG, "The setting %s is no boolean.", switches[i].key);
            *switches[i].value = kind(j, at) == 't';
        }
    for (uint32_t i = 0, at; object != 0 && i < 2; i++) {
        if ((at = member(j, object, sizes[i].key)) != 0 && !json_uint(j, at, 1, 1024, sizes[i].value))
            return fail(fault, STATUS_WRONG, "The setting %s is out of range.", sizes[i].key);
        if ((at = member(j, object, choices[i].key)) != 0) {
            if (!says(j, at, choices[i].usual) && !says(j, at, choices[i].other))
                return fail(fault, STATUS_WRONG, "The setting %s is neither %s nor %s.", choices[i].key,
                            choices[i].usual, choices[i].other);
            *choices[i].value = says(j, at, choices[i].other);
        }
    }
    if (s->max_event_bytes > s->max_block_bytes)
        return fail(fault, STATUS_WRONG, "The setting max_event_bytes is larger than max_block_bytes.");
    if (s->answer_spread > 0 && s->answer_spread >= fmin(fmin(s->vote_timeout, s->phase1_timeout),
                                                         fmin(s->phase2_timeout, s->phase3_timeout)))
        return fail(fault, STATUS_WRONG, "The setting answer_spread_s is not less than each of the four timers.");
    return true;
}

static bool mission_address(Json *j, uint32_t network, const char *key, struct in_addr *address) {
    char text[16];
    size_t n;
    uint32_t at = member(j, network, key);
    if (kind(j, at) != '"') return false;
    const char *s = json_text(j, at, &n);
    if (n >= sizeof text || memchr(s, '\0', n) != NULL) return false;
    memcpy(text, s, n);
    text[n] = '\0';
    return inet_pton(AF_INET, text, address) == 1;
}

/* A path; NULL where there is none. */
static bool mission_path(Json *j, uint32_t at, const char *what, char **path, Fault *fault) {
    size_t n;
    free(*path);
    *path = NULL;
    if (at == 0 || kind(j, at) == 'n') return true;
    const char *text = kind(j, at) == '"' ? json_text(j, at, &n) : NULL;
    if (text == NULL || n == 0 || memchr(text, '\0', n) != NULL)
        return fail(fault, STATUS_WRONG, "%s is neither null nor a path.", what);
    *path = grow(NULL, n + 1);
    memcpy(*path, text, n);
    (*path)[n] = '\0';
    return true;
}

static bool mission_read(Mission *m, Json *j, uint32_t root, Fault *fault) {
    uint64_t value;
    uint32_t at;
    if (kind(j, root) != '{' || !says(j, member(j, root, "schema"), "ucp-mission/1"))
        return fail(fault, STATUS_WRONG, "It is no mission of the schema ucp-mission/1.");
    bool has_data = json_bytes(j, member(j, root, "initial_data"), &m->initial_data);
    if (!mission_features(j, root, has_data && is_sealed(&m->initial_data), fault)) return false;
    if ((at = member(j, root, "contract")) != 0 && !json_uint(j, at, 1, UINT64_MAX, &value))
        return fail(fault, STATUS_WRONG, "contract is no version.");
    if (!json_uint(j, member(j, root, "agent_id"), 1, AGENT_IDS - 1, &value))
        return fail(fault, STATUS_WRONG, "agent_id is none of 1..65535.");
    m->agent_id = (uint16_t)value;
    uint32_t roster = member(j, root, "roster");
    bool named[AGENT_IDS] = {false};
    m->roster_len = 0;
    for (uint32_t i = roster + 1; kind(j, roster) == '[' && i < j->node[roster].end; i = j->node[i].end) {
        if (!json_uint(j, i, 1, AGENT_IDS - 1, &value))
            return fail(fault, STATUS_WRONG, "roster has what is none of 1..65535.");
        if (named[value]) continue;
        named[value] = true;
        if (m->roster_len % 64 == 0)
            m->roster = grow(m->roster, (m->roster_len + 64) * sizeof *m->roster);
        m->roster[m->roster_len++] = (uint16_t)value;
    }
    if (!named[m->agent_id]) return fail(fault, STATUS_WRONG, "roster is no list with this agent on it.");
    if (!has_data)
        return fail(fault, STATUS_WRONG, "initial_data is no base64.");
    uint32_t network = member(j, root, "network"), events = member(j, root, "events");
    if (kind(j, network) != '{' || !mission_address(j, network, "address", &m->address)
        || !mission_address(j, network, "broadcast", &m->broadcast)
        || !json_uint(j, member(j, network, "port"), 1, 65535, &value))
        return fail(fault, STATUS_WRONG, "network lacks an IPv4 address, a broadcast address, or a port.");
    m->port = (uint16_t)value;
    if (kind(j, events) != '{' || (!says(j, member(j, events, "source"), "random")
                                   && !says(j, member(j, events, "source"), "none")))
        return fail(fault, STATUS_WRONG, "The source of events is not known.");
    m->random_events = says(j, member(j, events, "source"), "random");
    m->mean_s = 30;
    if ((at = member(j, events, "mean_s")) != 0
        && (!json_double(j, at, &m->mean_s) || m->mean_s <= 0 || m->mean_s > 2678400))
        return fail(fault, STATUS_WRONG, "mean_s is not above 0 and at most 31 days.");
    if (!mission_settings(j, member(j, root, "settings"), &m->settings, fault)) return false;
    if (!json_uint(j, member(j, root, "seed"), 0, UINT64_MAX, &m->seed))
        return fail(fault, STATUS_WRONG, "seed is none of 0..2^64-1.");
    if (!json_double(j, member(j, root, "speedup"), &m->speedup) || m->speedup <= 0 || m->speedup > 1000)
        return fail(fault, STATUS_WRONG, "speedup is not above 0 and at most 1000.");
    at = member(j, root, "epoch_us");
    m->has_epoch = at != 0 && kind(j, at) != 'n';
    m->epoch_us = 0;
    if (m->has_epoch && !json_uint(j, at, 0, INT64_MAX, &m->epoch_us))
        return fail(fault, STATUS_WRONG, "epoch_us is neither null nor a time.");
    at = member(j, root, "security");
    if (at != 0 && kind(j, at) != 'n' && kind(j, member(j, at, "bundle")) != '"')
        return fail(fault, STATUS_WRONG, "security is neither null nor an object with a bundle.");
    if (is_sealed(&m->initial_data) && (at == 0 || kind(j, at) == 'n'))
        return fail(fault, STATUS_WRONG, "A depot's key ends initial_data, and there is no security.");
    if (at != 0 && kind(j, at) != 'n' && m->settings.answer_spread > 0)
        return fail(fault, STATUS_LACKS, "This agent does not have 'answer_spread_s' in a secured mission.");
    return mission_path(j, member(j, root, "store"), "store", &m->store, fault)
        && mission_path(j, member(j, at, "bundle"), "bundle", &m->bundle, fault);
}

/* ================================================================================================================
 * 5  Blocks, messages, and the state of an agent
 * ============================================================================================================= */

/* A block is in exactly one of chain, deque and stack, and belongs to the list that it is in. */
typedef struct {
    Hash hash, chain;                                   /* chain: its chain hash, while it is in the chain */
    uint64_t timestamp;
    uint16_t agent, size;                               /* size: bytes of data */
    uint8_t data[];                                     /* BD: header and event data */
} Block;

typedef struct { Block **at; size_t len, cap; } List;

static Block *block_new(const uint8_t *data, size_t size) {
    Block *block = grow(NULL, sizeof *block + size);
    memcpy(block->data, data, size);
    block->hash = H(data, size);
    block->agent = (uint16_t)read_be(data, 4);
    block->timestamp = read_be(data + 4, 8);
    block->size = (uint16_t)size;
    return block;
}

static bool block_well_formed(const uint8_t *data, size_t size) {
    return size > BLOCK_HEADER && size <= BLOCK_HEADER + MAX_EVENT_DATA
        && read_be(data, 4) >= 1 && read_be(data, 4) < AGENT_IDS;
}

static void list_push(List *list, Block *block) {
    if (list->len == list->cap)
        list->at = grow(list->at, (list->cap = list->cap * 2 + 32) * sizeof *list->at);
    list->at[list->len++] = block;
}

static Block *list_take(List *list, size_t i) {
    Block *block = list->at[i];
    memmove(list->at + i, list->at + i + 1, (--list->len - i) * sizeof *list->at);
    return block;
}

static void list_clear(List *list) {
    while (list->len > 0)
        free(list->at[--list->len]);
}

static ptrdiff_t list_find(const List *list, const Hash *hash) {   /* by block hash; -1: it is not there */
    for (size_t i = list->len; i-- > 0;)
        if (same(&list->at[i]->hash, hash)) return (ptrdiff_t)i;
    return -1;
}

/* A set of agents; it is emptied by counting on. */
typedef struct { uint32_t round, mark[AGENT_IDS]; } Set;

static void set_clear(Set *set) {
    if (++set->round == 0) {
        memset(set->mark, 0, sizeof set->mark);
        set->round = 1;
    }
}

static bool set_has(const Set *set, uint16_t agent) { return set->mark[agent] == set->round; }
static void set_add(Set *set, uint16_t agent) { set->mark[agent] = set->round; }

enum message_type {
    BLOCK_ADD_REQUEST = 1, BLOCK_ADD_RESPONSE, COMMIT_BLOCK, CHAIN_CONTAIN_QUERY, CHAIN_CONTAIN_RESPONSE,
    CHAIN_HASH_SUCCESSOR_QUERY, NEXT_IN_SEQUENCE_RESPONSE, REQUEST_FOR_BLOCK, BLOCK_RESPONSE
};

/* Of each type: its name, the algorithm that receives it, the sizes that its body can have. */
static const struct { const char *name; int algorithm; size_t least, most; bool between; } MESSAGES[] = {
    [BLOCK_ADD_REQUEST] = {"Block Add Request", 3, 64, 64, false},
    [BLOCK_ADD_RESPONSE] = {"Block Add Response", 4, 33, 65, false},
    [COMMIT_BLOCK] = {"Commit Block", 6, 45, 1068, true},
    [CHAIN_CONTAIN_QUERY] = {"Chain Contain Query", 9, 32, 32, false},
    [CHAIN_CONTAIN_RESPONSE] = {"Chain Contain Response", 10, 33, 33, false},
    [CHAIN_HASH_SUCCESSOR_QUERY] = {"Chain Hash Successor Query", 13, 32, 32, false},
    [NEXT_IN_SEQUENCE_RESPONSE] = {"Next in Sequence Response", 14, 40, 72, false},
    [REQUEST_FOR_BLOCK] = {"Request for Block", 17, 32, 32, false},
    [BLOCK_RESPONSE] = {"Block Response", 18, 13, 1036, true},
};

/* What came: a datagram's fields, or an event's. */
typedef struct {
    const uint8_t *raw;                                 /* the datagram, or the event as a block has it */
    size_t raw_len;
    int type;
    uint16_t sender;
    uint32_t sequence;
    bool yes, has_block, has_chain;
    Hash block, chain;
    uint64_t timestamp;                                 /* of types 7, and of events */
    const uint8_t *data;                                /* BD, of types 3 and 9 */
    size_t data_len;
} Input;

enum timer { VOTING, PHASE_ONE, PHASE_TWO, PHASE_THREE, FINALIZE_GAP, TIMERS, NO_TIMER = -1 };
static const struct { const char *name; int algorithm; } TIMER[TIMERS] = {
    {"voting", 5}, {"phase one", 11}, {"phase two", 15}, {"phase three", 19}, {"finalize gap", 20}};

enum change { COMPLETE, CHAIN_PUSH, CHAIN_POP, DEQUE_PUSH, DEQUE_POP, STACK_PUSH, STACK_TAKE, CHANGES,
              SIGNED = CHANGES, LIVED, REVOKED };           /* those of keys are in the store alone */
static const char *const CHANGE[CHANGES] = {"complete", "chain+", "chain-", "deque+", "deque-", "stack+", "stack-"};

enum drop {
    GOOD = -1, TRUNCATED, OVERSIZED, WRONG_MAGIC, WRONG_VERSION, IMPOSSIBLE_SENDER, WRONG_LENGTH, UNKNOWN_TYPE,
    BAD_VOTE, IMPOSSIBLE_AGENT, OWN_SENDER, STRANGER, STRANGERS_BLOCK,
    NOT_SECURED, REVOKED_SENDER, NOT_THE_AUTHORITY, KNOWN_ALREADY, EPOCH_OUT_OF_RANGE, OLD_BOOT, REPLAYED,     /* with keys */
    NOT_AUTHENTIC, NOT_THE_SENDER, ANSWERS_NO_REQUEST, NOT_THE_MAKER, NOT_CONFIRMED, DROPS
};
static const char *const DROP[DROPS] = {
    "truncated", "oversized", "wrong magic", "wrong version", "impossible sender", "wrong length", "unknown type",
    "bad vote", "impossible agent", "own sender", "sender not on the roster", "block not of the roster",
    "not secured", "revoked sender", "not signed by the authority", "known already", "epoch out of range", "old boot",
    "replayed", "not authentic", "not signed by its sender", "answers no request", "block not signed by its maker",
    "not confirmed"};

typedef struct { uint64_t yes, no; } Count;
typedef struct { bool is_top; Hash block; uint64_t count, timestamp; } Candidate;   /* is_top: Is Top Of Chain */

enum trigger { BY_MESSAGE, BY_TIMER, BY_EVENT, BY_LOCAL, BY_OPERATOR, BY_BOOT };

typedef struct Keys Keys;

typedef struct {
    Mission m;
    Keys *keys;                                         /* NULL: the mission is not secured */
    Set roster;
    Hash bh0, ch0;

    /* The state of the contract's table. */
    List chain, deque, stack;
    Hash top;
    uint8_t current[MAX_EVENT_DATA];
    size_t current_len;
    Buf completed;                                      /* hashes, 32 bytes each */
    bool has_newest;                                    /* false: newest_block_timestamp is -1 */
    uint64_t newest;
    bool reconciling;
    uint64_t reconciles;
    struct { bool runs; double deadline, duration; uint64_t since; } timer[TIMERS];     /* since: number of an input */
    Hash candidate, top_at_initiation;
    Count votes, answers;
    Set voters, responders;
    Candidate *candidates;                              /* at most one for each of the roster */
    size_t candidates_len, chosen;
    bool has_majority;
    Hash majority;
    uint32_t sequence;

    /* The mission's course, and what the status counts. */
    bool started, no_events, boots;
    uint64_t handled, bytes_sent, send_failures, dropped[DROPS];

    /* The input that is being taken: when, the local events that wait, what is to be done once it is over. */
    uint64_t inputs;
    double now;
    char t[400];                                        /* now as the trace has it */
    struct { int algorithm, by; } local[8];
    size_t local_len;
    Buf out;                                            /* datagrams to send, each after its length (u16) */
    Buf waiting;                                        /* answers: when to send (double), and as in `out` */
    bool tracing, keeping;
    Buf lines;                                          /* for the trace */
    Buf journal;                                        /* for the store */

    /* The handler that runs, and what its line in the trace will say. */
    int running;
    const Input *in;
    bool counts;                                        /* it has a tally */
    unsigned started_timers;                            /* a bit for each */
    Buf body;                                           /* of the message that it is about to send */
    Buf changes, sent;                                  /* JSON */
    Buf sealed;                                         /* event data that it sealed */
} Agent;

static size_t completed_len(const Agent *a) { return a->completed.len / 32; }

static bool has_completed(const Agent *a, const Block *block) {
    for (size_t i = 0; i < completed_len(a) && block->agent == a->m.agent_id; i++)
        if (memcmp(a->completed.data + 32 * i, block->hash.b, 32) == 0) return true;
    return false;
}

static bool holds(const Agent *a, const Hash *hash) {
    return list_find(&a->chain, hash) >= 0 || list_find(&a->deque, hash) >= 0 || list_find(&a->stack, hash) >= 0;
}

enum { NOT_IN_CHAIN = -2, INCEPTION = -1 };

static ptrdiff_t chain_find(const Agent *a, const Hash *chain) {   /* by chain hash */
    for (size_t i = a->chain.len; i-- > 0;)
        if (same(&a->chain.at[i]->chain, chain)) return (ptrdiff_t)i;
    return same(chain, &a->ch0) ? INCEPTION : NOT_IN_CHAIN;
}

static bool is_idle(const Agent *a) {
    for (int i = 0; i < TIMERS; i++)
        if (a->timer[i].runs) return false;
    return !a->reconciling && a->local_len == 0;
}

/* The chain's ends. Everything that changes a list goes through here or through `change` below. */
static void chain_push(Agent *a, Block *block) {
    a->top = block->chain = H_chain(&a->top, &block->hash);
    list_push(&a->chain, block);
}

static Block *chain_pop(Agent *a) {
    Block *block = list_take(&a->chain, a->chain.len - 1);
    a->top = a->chain.len > 0 ? a->chain.at[a->chain.len - 1]->chain : a->ch0;
    return block;
}

static void put_change(Buf *b, enum change what, const uint8_t *hash) {
    put_text(b, b->len > 0 ? ",[\"" : "[\"");
    put_text(b, CHANGE[what]);
    put_text(b, "\",\"");
    put_hex(b, hash, 32);
    put_text(b, "\"]");
}

static void put_journal(Buf *b, enum change what, const Block *block) {         /* as the store has it, section 9 */
    put_byte(b, (uint8_t)what);
    if (what == COMPLETE || what == STACK_TAKE) {
        put(b, block->hash.b, 32);
    } else if (what == CHAIN_PUSH || what == DEQUE_PUSH || what == STACK_PUSH) {
        put_be(b, block->size, 2);
        put(b, block->data, block->size);
    }
}

static void change(Agent *a, enum change what, const Block *block) {   /* record it: for the trace, for the store */
    if (a->tracing)
        put_change(&a->changes, what, block->hash.b);
    if (a->keeping)
        put_journal(&a->journal, what, block);
}

static void complete(Agent *a, Block *block) {
    put(&a->completed, block->hash.b, 32);
    a->has_newest = true;
    a->newest = block->timestamp;
    change(a, COMPLETE, block);
    list_push(&a->deque, block);
    change(a, DEQUE_PUSH, block);
}

static void commit(Agent *a, Block *block) {
    chain_push(a, block);
    change(a, CHAIN_PUSH, block);
}

static void trigger(Agent *a, int algorithm) {
    if (a->local_len < sizeof a->local / sizeof *a->local) {    /* each is followed by at most one other */
        a->local[a->local_len].algorithm = algorithm;
        a->local[a->local_len++].by = a->running;
    }
}

static void start_timer(Agent *a, enum timer timer, double duration) {
    a->timer[timer].runs = true;
    a->timer[timer].duration = duration;
    a->timer[timer].deadline = a->now + duration;
    a->timer[timer].since = a->inputs;
    a->started_timers |= 1u << timer;
}

/* --- Messages out: the body is put together in `body`; `block` is what the trace says that it names. ------------- */

static void put_hash(Buf *b, const Hash *hash) { put(b, hash->b, 32); }

static void send_message(Agent *a, enum message_type type, const Hash *block) {
    size_t at = a->out.len + 2, size = HEADER + a->body.len;
    put_be(&a->out, size, 2);
    put(&a->out, "UC\1", 3);
    put_byte(&a->out, (uint8_t)type);
    put_be(&a->out, a->m.agent_id, 4);
    put_be(&a->out, a->sequence, 4);
    put_be(&a->out, a->body.len, 2);
    put(&a->out, a->body.data, a->body.len);
    a->body.len = 0;
    if (a->tracing) {
        put_format(&a->sent, "%s{\"message\":\"%s\",\"seq\":%" PRIu32 ",\"block\":%s", a->sent.len > 0 ? "," : "",
                   MESSAGES[type].name, a->sequence, block != NULL ? "\"" : "null");
        if (block != NULL)
            put_hex(&a->sent, block->b, 32);
        put_text(&a->sent, block != NULL ? "\",\"datagram\":\"" : ",\"datagram\":\"");
        put_base64(&a->sent, a->out.data + at, size);
        put_text(&a->sent, "\"}");
    }
    a->sequence++;
}

static bool is_answer(uint8_t type) {
    return type == BLOCK_ADD_RESPONSE || type == CHAIN_CONTAIN_RESPONSE || type == NEXT_IN_SEQUENCE_RESPONSE
        || type == BLOCK_RESPONSE;
}

/* The setting answer_spread_s. Returns when the next waiting answer is due, and its place; infinity without one. */
static double next_answer(const Agent *a, size_t *place) {
    double first = INFINITY, due;
    for (size_t at = 0; at < a->waiting.len; at += sizeof due + 2 + (size_t)read_be(a->waiting.data + at + sizeof due, 2)) {
        memcpy(&due, a->waiting.data + at, sizeof due);
        if (due < first) {
            first = due;
            *place = at;
        }
    }
    return first;
}

/* Leaves in `out` what is to be sent now: the answers that have waited, then all new messages that are no answers. */
static void hold_answers(Agent *a) {
    Buf others = {0};
    size_t place;
    if (a->m.settings.answer_spread == 0) return;
    for (size_t at = 0, n; at < a->out.len; at += 2 + n) {
        const uint8_t *datagram = a->out.data + at + 2;
        n = (size_t)read_be(a->out.data + at, 2);
        if (!is_answer(datagram[3])) {
            put(&others, datagram - 2, 2 + n);
            continue;
        }
        Hash hash = H(datagram, n);
        double wait = a->m.settings.answer_spread * ((double)read_be(hash.b, 8) * 0x1p-64), due = a->now + wait;
        put(&a->waiting, (const uint8_t *)&due, sizeof due);
        put(&a->waiting, datagram - 2, 2 + n);
    }
    a->out.len = 0;
    while (next_answer(a, &place) <= a->now) {
        uint8_t *due = a->waiting.data + place;
        size_t n = 2 + (size_t)read_be(due + sizeof(double), 2), whole = sizeof(double) + n;
        put(&a->out, due + sizeof(double), n);
        memmove(due, due + whole, a->waiting.len - place - whole);
        a->waiting.len -= whole;
    }
    put(&a->out, others.data, others.len);
    free(others.data);
}

static void send_commit(Agent *a, const Block *block) {
    put_hash(&a->body, &block->chain);                  /* its own chain hash, the new top */
    put(&a->body, block->data, block->size);
    send_message(a, COMMIT_BLOCK, &block->hash);
}

/* --- Messages in: the first test that fails says why a datagram is dropped. -------------------------------------- */

static enum drop read_datagram(const Agent *a, const uint8_t *d, size_t n, Input *in) {
    if (n < HEADER) return TRUNCATED;
    if (n > MAX_DATAGRAM) return OVERSIZED;
    if (d[0] != 'U' || d[1] != 'C') return WRONG_MAGIC;
    if (d[2] != 1) return WRONG_VERSION;
    uint32_t sender = (uint32_t)read_be(d + 4, 4);
    if (sender < 1 || sender >= AGENT_IDS) return IMPOSSIBLE_SENDER;
    const uint8_t *body = d + HEADER;
    size_t size = n - HEADER;
    int type = d[3];
    if (read_be(d + 12, 2) != size) return WRONG_LENGTH;
    if (type < BLOCK_ADD_REQUEST || type > BLOCK_RESPONSE) return UNKNOWN_TYPE;
    if ((type == BLOCK_ADD_RESPONSE || type == CHAIN_CONTAIN_RESPONSE) && (size == 0 || body[0] > 1)) return BAD_VOTE;
    size_t least = MESSAGES[type].least, most = MESSAGES[type].most;
    if (MESSAGES[type].between ? size < least || size > most : size != least && size != most) return WRONG_LENGTH;

    *in = (Input){.raw = d, .raw_len = n, .type = type, .sender = (uint16_t)sender,
                  .sequence = (uint32_t)read_be(d + 8, 4)};
    const uint8_t *block = NULL, *chain = NULL;
    switch (type) {
    case BLOCK_ADD_REQUEST:             block = body; chain = body + 32; break;
    case BLOCK_ADD_RESPONSE:
        in->yes = body[0]; block = body + 1; chain = size == 65 ? body + 33 : NULL; break;
    case COMMIT_BLOCK:                  chain = body; in->data = body + 32; in->data_len = size - 32; break;
    case CHAIN_CONTAIN_RESPONSE:        in->yes = body[0]; chain = body + 1; break;
    case CHAIN_CONTAIN_QUERY:
    case CHAIN_HASH_SUCCESSOR_QUERY:    chain = body; break;
    case NEXT_IN_SEQUENCE_RESPONSE:
        in->timestamp = read_be(body, 8); chain = body + 8; block = size == 72 ? body + 40 : NULL; break;
    case REQUEST_FOR_BLOCK:             block = body; break;
    case BLOCK_RESPONSE:                in->data = body; in->data_len = size; break;
    }
    if ((in->has_block = block != NULL))
        memcpy(in->block.b, block, 32);
    if ((in->has_chain = chain != NULL))
        memcpy(in->chain.b, chain, 32);

    if (in->data != NULL && !block_well_formed(in->data, in->data_len)) return IMPOSSIBLE_AGENT;
    if (sender == a->m.agent_id) return OWN_SENDER;
    if (!set_has(&a->roster, (uint16_t)sender)) return STRANGER;
    if (in->data != NULL && !set_has(&a->roster, (uint16_t)read_be(in->data, 4))) return STRANGERS_BLOCK;
    return GOOD;
}

/* --- Keys: without them none of these is called, for `keys` is NULL. ---------------------------------------------- */

#ifdef SECURED
#include "ucp_secured.c"
#else
typedef struct { int type; uint32_t sender; } Opened;
enum { BOOT = 16, REVOCATION = 10 };
#define keys_free(a) ((void)(a))
#define keys_read(a, j, bundle, boot, fault) ((void)(a), (void)(j), (void)(bundle), (void)(boot), false)
#define keys_open(a, now, d, n, plain, opened) ((void)(now), (void)(opened), TRUNCATED)
#define keys_allow(a, now, opened, in, drop) (drop)
#define keys_keep(a, opened, in) ((void)(opened))
#define keys_seal(a, heard) ((void)(heard))
#define keys_revoke(a, now, body, n) ((void)(body), (void)(n), TRUNCATED)
#define keys_signature(a, data, n) ((const uint8_t *)NULL)
#define keys_seals(a) false
#define keys_seal_events(a, timestamp, out) ((void)(out), (size_t)0)
#define keys_replay(a, what, at, n) ((size_t)0)
#define keys_boot(a) ((void)(a))
#define keys_moved(a) false
#define keys_begin(a) ((void)(a))
#define put_head(b, a, exported_at) ((void)(b))
#define put_keys_store(b, a) ((void)(b))
#define put_lived(b, keys) ((void)(b))
#define put_bundle(b, j, bundle, keys) ((void)(b))
#endif

/* ================================================================================================================
 * 6  The 20 algorithms. Each returns the branch that it took.
 * ============================================================================================================= */

enum algorithm {                                        /* those that are triggered by local events */
    PROCESS_NEXT_DEQUE_BLOCK = 2, RECONCILE_BEGIN = 7, RECONCILE_PHASE_1 = 8, RECONCILE_PHASE_2 = 12,
    RECONCILE_PHASE_3 = 16, RECONCILE_FINALIZE = 20
};

/* --- Commit ------------------------------------------------------------------------------------------------------ */

/* Algorithm 1: an event is logged. */
static const char *build_data_block(Agent *a) {
    memcpy(a->current + a->current_len, a->in->raw, a->in->raw_len);
    a->current_len += a->in->raw_len;
    if (a->current_len + a->m.settings.max_event_bytes < a->m.settings.max_block_bytes) return "building";
    uint64_t timestamp = a->in->timestamp;
    if (a->has_newest && timestamp <= a->newest)
        timestamp = a->newest + (a->newest < UINT64_MAX);       /* at the end of time it stands still */
    uint8_t data[BLOCK_HEADER + MAX_EVENT_DATA];
    write_be(data, a->m.agent_id, 4);
    write_be(data + 4, timestamp, 8);
    size_t size = a->current_len;
    if (a->keys != NULL && keys_seals(a)) {
        size = keys_seal_events(a, timestamp, data + BLOCK_HEADER);
        put(&a->sealed, data + BLOCK_HEADER, size);
    } else {
        memcpy(data + BLOCK_HEADER, a->current, size);
    }
    complete(a, block_new(data, BLOCK_HEADER + size));
    a->current_len = 0;
    trigger(a, PROCESS_NEXT_DEQUE_BLOCK);
    return "full";
}

/* Algorithm 2: the front of the deque is proposed. */
static const char *process_next_deque_block(Agent *a) {
    if (a->reconciling) return "reconcile in progress";
    if (a->timer[VOTING].runs) return "vote running";
    if (a->deque.len == 0) return "deque empty";
    a->votes = (Count){1, 0};                           /* its own approval counts */
    set_clear(&a->voters);
    a->top_at_initiation = a->top;
    a->candidate = a->deque.at[0]->hash;                /* it stays in the deque */
    start_timer(a, VOTING, a->m.settings.vote_timeout);
    put_hash(&a->body, &a->candidate);
    put_hash(&a->body, &a->top);
    send_message(a, BLOCK_ADD_REQUEST, &a->candidate);
    a->counts = true;
    return "proposed";
}

/* Algorithm 3: Block Add Request. */
static const char *receive_request_add_block(Agent *a) {
    if (a->reconciling) return "reconcile in progress";
    bool approve = same(&a->in->chain, &a->top);
    put_byte(&a->body, approve);
    put_hash(&a->body, &a->in->block);
    if (a->m.settings.vote_names_chain)
        put_hash(&a->body, &a->in->chain);
    send_message(a, BLOCK_ADD_RESPONSE, &a->in->block);
    return approve ? "approve" : "disapprove";
}

/* Algorithm 4: Block Add Response. */
static const char *receive_vote_add_block(Agent *a) {
    if (!a->timer[VOTING].runs) return "no vote running";
    if (!same(&a->in->block, &a->candidate)) return "another block";
    if (a->m.settings.vote_names_chain && (!a->in->has_chain || !same(&a->in->chain, &a->top_at_initiation)))
        return "another round";
    if (set_has(&a->voters, a->in->sender)) return "counted already";
    set_add(&a->voters, a->in->sender);
    *(a->in->yes ? &a->votes.yes : &a->votes.no) += 1;
    a->counts = true;
    return a->in->yes ? "yes" : "no";
}

/* Algorithm 5: the voting timer. */
static const char *vote_timer_expiration(Agent *a) {
    if (a->reconciling) return "reconcile in progress";
    bool changed = !same(&a->top, &a->top_at_initiation);
    bool approved = a->votes.yes > a->votes.no;         /* a tie is not approved */
    if (changed && (approved || a->m.settings.changed_before_tally)) {
        trigger(a, PROCESS_NEXT_DEQUE_BLOCK);
        return "chain changed";
    }
    if (!approved) {
        trigger(a, RECONCILE_BEGIN);
        return "not approved";
    }
    Block *block = list_take(&a->deque, 0);
    change(a, DEQUE_POP, block);
    commit(a, block);
    send_commit(a, block);
    if (a->m.settings.asks_after_commit)
        start_timer(a, FINALIZE_GAP, a->m.settings.finalize_gap);
    trigger(a, PROCESS_NEXT_DEQUE_BLOCK);
    return "approved";
}

/* Algorithm 6: Commit Block. */
static const char *receive_commit_block(Agent *a) {
    if (a->reconciling) return "reconcile in progress";
    Hash hash = H(a->in->data, a->in->data_len), successor = H_chain(&a->top, &hash);
    if (!same(&a->in->chain, &successor)) return "does not succeed";
    if (holds(a, &hash)) return "held already";
    commit(a, block_new(a->in->data, a->in->data_len));
    return "committed";
}

/* --- Reconcile --------------------------------------------------------------------------------------------------- */

/* Algorithm 7: Reconcile Begin. */
static const char *reconcile_begin(Agent *a) {
    if (a->reconciling) return "already in progress";
    a->reconciling = true;
    a->reconciles++;
    if (a->m.settings.asks_after_commit)
        a->timer[FINALIZE_GAP].runs = false;            /* phase 2 asks the same */
    trigger(a, RECONCILE_PHASE_1);
    return "begun";
}

/* Algorithm 8: is my top block in your chains? */
static const char *reconcile_phase_1(Agent *a) {
    a->answers = (Count){0, 0};
    set_clear(&a->responders);
    put_hash(&a->body, &a->top);
    send_message(a, CHAIN_CONTAIN_QUERY, NULL);
    start_timer(a, PHASE_ONE, a->m.settings.phase1_timeout);
    a->counts = true;
    return "asked";
}

/* Algorithm 9: Chain Contain Query. */
static const char *receive_request_chain_contain(Agent *a) {
    if (a->reconciling) return "reconcile in progress";
    bool contained = chain_find(a, &a->in->chain) != NOT_IN_CHAIN;
    put_byte(&a->body, contained);
    put_hash(&a->body, &a->in->chain);
    send_message(a, CHAIN_CONTAIN_RESPONSE, NULL);
    return contained ? "yes" : "no";
}

/* Algorithm 10: Chain Contain Response. */
static const char *receive_phase_1_response(Agent *a) {
    if (!a->timer[PHASE_ONE].runs) return "not in phase 1";
    if (!same(&a->in->chain, &a->top)) return "another chain";
    if (set_has(&a->responders, a->in->sender)) return "counted already";
    set_add(&a->responders, a->in->sender);
    *(a->in->yes ? &a->answers.yes : &a->answers.no) += 1;
    a->counts = true;
    return a->in->yes ? "yes" : "no";
}

/* Algorithm 11: the phase one timer. */
static const char *reconcile_phase_1_timer_expiration(Agent *a) {
    uint64_t yes = a->answers.yes, no = a->answers.no;
    if (yes + no == 0) {
        trigger(a, RECONCILE_FINALIZE);
        return "no response";
    }
    if (yes < no || (yes == no && a->m.settings.phase1_tie_pop)) {
        if (a->chain.len == 0) {                        /* the inception block is never popped */
            trigger(a, RECONCILE_FINALIZE);
            return "at inception";
        }
        Block *block = chain_pop(a);
        change(a, CHAIN_POP, block);
        list_push(&a->stack, block);
        change(a, STACK_PUSH, block);
        trigger(a, RECONCILE_PHASE_1);
        return "not contained";
    }
    trigger(a, RECONCILE_PHASE_2);
    return "contained";
}

/* Algorithm 12: what comes next in your chains? */
static const char *reconcile_phase_2(Agent *a) {
    a->candidates_len = 0;
    set_clear(&a->responders);
    start_timer(a, PHASE_TWO, a->m.settings.phase2_timeout);
    put_hash(&a->body, &a->top);
    send_message(a, CHAIN_HASH_SUCCESSOR_QUERY, NULL);
    a->counts = true;
    return "asked";
}

/* Algorithm 13: Chain Hash Successor Query. */
static const char *receive_request_next_in_sequence(Agent *a) {
    if (a->reconciling) return "reconcile in progress";
    ptrdiff_t at = chain_find(a, &a->in->chain);
    if (at == NOT_IN_CHAIN) {                           /* its own chain has diverged */
        trigger(a, RECONCILE_BEGIN);
        return "diverged";
    }
    bool is_top = same(&a->in->chain, &a->top);
    const Block *block = is_top && at == INCEPTION ? NULL : a->chain.at[is_top ? at : at + 1];
    put_be(&a->body, block != NULL ? block->timestamp : 0, 8);
    put_hash(&a->body, &a->in->chain);
    if (!is_top)
        put_hash(&a->body, &block->hash);
    send_message(a, NEXT_IN_SEQUENCE_RESPONSE, is_top ? NULL : &block->hash);
    return is_top ? "top of chain" : "successor";
}

/* Algorithm 14: Next in Sequence Response. */
static const char *receive_response_next_in_sequence(Agent *a) {
    if (!a->timer[PHASE_TWO].runs) return "not in phase 2";
    if (!same(&a->in->chain, &a->top)) return "another chain";
    if (set_has(&a->responders, a->in->sender)) return "counted already";
    set_add(&a->responders, a->in->sender);
    a->counts = true;
    for (Candidate *c = a->candidates; c < a->candidates + a->candidates_len; c++)
        if (c->is_top ? !a->in->has_block : a->in->has_block && same(&c->block, &a->in->block)) {
            c->count++;                                 /* the timestamp stays the first one's */
            return "counted";
        }
    a->candidates[a->candidates_len++] = (Candidate){!a->in->has_block, a->in->block, 1, a->in->timestamp};
    return "new candidate";
}

static bool goes_before(const Candidate *x, const Candidate *y) {   /* of those with the highest count */
    if (x->timestamp != y->timestamp) return x->timestamp < y->timestamp;
    if (x->is_top || y->is_top)
        return x->is_top;                               /* lower than any hash */
    return memcmp(x->block.b, y->block.b, 32) < 0;
}

/* Algorithm 15: the phase two timer. */
static const char *reconcile_phase_2_timer_expiration(Agent *a) {
    if (a->candidates_len == 0) {
        trigger(a, RECONCILE_FINALIZE);
        return "no response";
    }
    uint64_t highest = 0, with_us = 1, others = 0;
    size_t tied = 0;
    for (size_t i = 0; i < a->candidates_len; i++)
        *(a->candidates[i].is_top ? &with_us : &others) += a->candidates[i].count;
    bool never_top = a->m.settings.top_needs_majority && with_us <= others;
    for (size_t i = 0; i < a->candidates_len; i++) {
        if (a->candidates[i].is_top && never_top) continue;
        if (a->candidates[i].count > highest) {
            highest = a->candidates[i].count;
            tied = 0;
        }
        tied += a->candidates[i].count == highest;
    }
    bool tie = tied > 1;
    const Candidate *chosen = NULL;
    for (const Candidate *c = a->candidates; c < a->candidates + a->candidates_len; c++)
        if (c->count == highest && !(c->is_top && (never_top || (tie && a->m.settings.phase2_tie_block)))
            && (chosen == NULL || goes_before(c, chosen)))
            chosen = c;
    if (chosen->is_top) {
        trigger(a, RECONCILE_FINALIZE);
        return tie ? "tie: top of chain" : "top of chain";
    }
    a->chosen = (size_t)(chosen - a->candidates);
    a->has_majority = true;
    a->majority = chosen->block;
    trigger(a, RECONCILE_PHASE_3);
    a->counts = true;
    return tie ? "tie: block" : "block";
}

/* Algorithm 16: get the block that the majority has next. */
static const char *reconcile_phase_3(Agent *a) {
    ptrdiff_t at = list_find(&a->stack, &a->majority);
    if (at >= 0) {
        Block *block = list_take(&a->stack, (size_t)at);
        change(a, STACK_TAKE, block);
        commit(a, block);
        a->has_majority = false;
        trigger(a, RECONCILE_PHASE_2);
        return "from the stack";
    }
    if (holds(a, &a->majority)) {
        a->has_majority = false;
        trigger(a, RECONCILE_FINALIZE);
        return "held already";
    }
    start_timer(a, PHASE_THREE, a->m.settings.phase3_timeout);
    put_hash(&a->body, &a->majority);
    send_message(a, REQUEST_FOR_BLOCK, &a->majority);
    return "asked";
}

/* Algorithm 17: Request for Block. */
static const char *receive_request_block_for_hash(Agent *a) {
    if (a->reconciling) return "reconcile in progress";
    ptrdiff_t at = list_find(&a->chain, &a->in->block);
    if (at < 0) return "not held";
    const Block *block = a->chain.at[at];
    put(&a->body, block->data, block->size);
    send_message(a, BLOCK_RESPONSE, &block->hash);
    return "sent";
}

/* Algorithm 18: Block Response. */
static const char *receive_response_block_for_hash(Agent *a) {
    if (!a->timer[PHASE_THREE].runs) return "not in phase 3";
    Hash hash = H(a->in->data, a->in->data_len);
    if (!a->has_majority || !same(&hash, &a->majority))
        return "another block";                         /* the timer runs on as it was */
    a->timer[PHASE_THREE].runs = false;
    commit(a, block_new(a->in->data, a->in->data_len));
    a->has_majority = false;
    trigger(a, RECONCILE_PHASE_2);
    return "committed";
}

/* Algorithm 19: the phase three timer. What was rebuilt stays. */
static const char *reconcile_phase_3_timer_expiration(Agent *a) {
    a->has_majority = false;
    trigger(a, RECONCILE_FINALIZE);
    return "gave up";
}

/* Algorithm 20: what is left on the stack goes back on the chain. */
static const char *reconcile_finalize(Agent *a) {
    if (a->m.settings.asks_after_commit && !a->reconciling) {      /* a gap after a commit of Algorithm 5 */
        put_hash(&a->body, &a->top);
        send_message(a, CHAIN_HASH_SUCCESSOR_QUERY, NULL);
        return "asked who follows";
    }
    while (a->stack.len > 0) {
        Block *block = list_take(&a->stack, a->stack.len - 1);
        change(a, STACK_TAKE, block);
        commit(a, block);
        send_commit(a, block);
        if (a->stack.len > 0 && a->m.settings.finalize_gap > 0) {
            start_timer(a, FINALIZE_GAP, a->m.settings.finalize_gap);
            return "recommitted, more to come";
        }
    }
    a->reconciling = false;
    trigger(a, PROCESS_NEXT_DEQUE_BLOCK);
    return "done";
}

static const struct { const char *name; const char *(*run)(Agent *); } ALGORITHM[] = {
    [1] = {"build_data_block", build_data_block},
    [2] = {"process_next_deque_block", process_next_deque_block},
    [3] = {"receive_request_add_block", receive_request_add_block},
    [4] = {"receive_vote_add_block", receive_vote_add_block},
    [5] = {"vote_timer_expiration", vote_timer_expiration},
    [6] = {"receive_commit_block", receive_commit_block},
    [7] = {"reconcile_begin", reconcile_begin},
    [8] = {"reconcile_phase_1", reconcile_phase_1},
    [9] = {"receive_request_chain_contain", receive_request_chain_contain},
    [10] = {"receive_phase_1_response", receive_phase_1_response},
    [11] = {"reconcile_phase_1_timer_expiration", reconcile_phase_1_timer_expiration},
    [12] = {"reconcile_phase_2", reconcile_phase_2},
    [13] = {"receive_request_next_in_sequence", receive_request_next_in_sequence},
    [14] = {"receive_response_next_in_sequence", receive_response_next_in_sequence},
    [15] = {"reconcile_phase_2_timer_expiration", reconcile_phase_2_timer_expiration},
    [16] = {"reconcile_phase_3", reconcile_phase_3},
    [17] = {"receive_request_block_for_hash", receive_request_block_for_hash},
    [18] = {"receive_response_block_for_hash", receive_response_block_for_hash},
    [19] = {"reconcile_phase_3_timer_expiration", reconcile_phase_3_timer_expiration},
    [20] = {"reconcile_finalize", reconcile_finalize},
};

/* ================================================================================================================
 * 7  How an agent runs: inputs, one after another, each with the handlers that it leads to
 * ============================================================================================================= */

static const char *truth(bool it) { return it ? "true" : "false"; }

static void put_tally(Buf *b, const Agent *a, int algorithm) {
    if (algorithm == 2 || algorithm == 4 || algorithm == 8 || algorithm == 10) {
        const Count *count = algorithm <= 4 ? &a->votes : &a->answers;
        put_format(b, "\"yes\":%" PRIu64 ",\"no\":%" PRIu64, count->yes, count->no);
        return;
    }
    for (size_t i = 0; i < a->candidates_len; i++) {
        const Candidate *c = &a->candidates[i];
        if (algorithm == 15 && i != a->chosen) continue;
        put_text(b, i > 0 && algorithm != 15 ? ",\"" : "\"");
        put_hex(b, c->block.b, c->is_top ? 0 : 32);
        if (algorithm == 15)
            put_format(b, "\":%" PRIu64, c->count);
        else
            put_format(b, "\":[%" PRIu64 ",%" PRIu64 "]", c->count, c->timestamp);
    }
}

static void put_run(Agent *a, int algorithm, enum trigger by, uint64_t which, const char *branch) {
    Buf *b = &a->lines;
    put_format(b, "{\"t\":%s,\"handler\":\"%s\",\"algorithm\":%d,\"trigger\":", a->t, ALGORITHM[algorithm].name,
               algorithm);
    switch (by) {
    case BY_MESSAGE:
        put_format(b, "{\"message\":\"%s\",\"from\":%u,\"seq\":%" PRIu32 "}", MESSAGES[a->in->type].name, a->in->sender,
                   a->in->sequence);
        break;
    case BY_TIMER:      put_format(b, "{\"timer\":\"%s\"}", TIMER[which].name); break;
    case BY_EVENT:      put_format(b, "{\"event\":%" PRIu64 "}", which); break;
    case BY_LOCAL:      put_format(b, "{\"local\":\"%s\"}", ALGORITHM[which].name); break;
    case BY_OPERATOR:   put_text(b, "{\"operator\":\"reconcile\"}"); break;
    case BY_BOOT:       put_format(b, "{\"boot\":%" PRIu64 "}", which); break;
    }
    if (a->in != NULL) {
        put_text(b, ",\"input\":\"");
        put_base64(b, a->in->raw, a->in->raw_len);
        put_byte(b, '"');
    }
    put_format(b, ",\"branch\":\"%s\",\"changes\":[", branch);
    put(b, a->changes.data, a->changes.len);
    put_text(b, "],\"sent\":[");
    put(b, a->sent.data, a->sent.len);
    put_byte(b, ']');
    if (a->counts) {
        put_text(b, ",\"tally\":{");
        put_tally(b, a, algorithm);
        put_byte(b, '}');
    }
    for (int i = 0; i < TIMERS; i++)                    /* a handler starts one at most */
        if (a->started_timers & 1u << i)
            put_format(b, ",\"started\":{\"%s\":%.17g}", TIMER[i].name, a->timer[i].duration);
    if (a->sealed.len > 0) {
        put_text(b, ",\"sealed\":\"");
        put_base64(b, a->sealed.data, a->sealed.len);
        put_byte(b, '"');
    }
    put_format(b, ",\"state\":{\"chain\":%zu,\"deque\":%zu,\"stack\":%zu,\"reconciling\":%s,\"idle\":%s,\"top\":\"",
               a->chain.len, a->deque.len, a->stack.len, truth(a->reconciling), truth(is_idle(a)));
    put_hex(b, a->top.b, 32);
    put_text(b, "\"}}\n");
}

/* One handler, from its beginning to its end. What was put into `changes` before it is part of its line. */
static void run_handler(Agent *a, int algorithm, enum trigger by, uint64_t which, const Input *in) {
    a->running = algorithm;
    a->in = in;
    a->counts = false;
    a->started_timers = 0;
    const char *branch = ALGORITHM[algorithm].run(a);
    a->handled++;
    if (a->tracing)
        put_run(a, algorithm, by, which, branch);
    a->changes.len = a->sent.len = a->sealed.len = 0;
}

/* The handler of an input, then those of local events, first in first out. */
static void run_all(Agent *a, int algorithm, enum trigger by, uint64_t which, const Input *in) {
    run_handler(a, algorithm, by, which, in);
    while (a->local_len > 0) {
        int next = a->local[0].algorithm, from = a->local[0].by;
        memmove(a->local, a->local + 1, --a->local_len * sizeof *a->local);
        run_handler(a, next, BY_LOCAL, (uint64_t)from, NULL);
    }
}

static void begin_input(Agent *a, double now) {
    a->now = now;
    a->inputs++;
    if (a->tracing)
        snprintf(a->t, sizeof a->t, "%.6f", now);
}

static void drop_datagram(Agent *a, enum drop drop, const uint8_t *datagram, size_t n) {
    a->dropped[drop]++;
    if (a->tracing) {
        put_format(&a->lines, "{\"t\":%s,\"dropped\":\"%s\",\"datagram\":\"", a->t, DROP[drop]);
        put_base64(&a->lines, datagram, n);
        put_text(&a->lines, "\"}\n");
    }
}

/* A revocation that was new is a command, from whoever it came; 0: from the control socket. */
static void note_revocation(Agent *a, const uint8_t *body, size_t n, uint32_t from) {
    if (!a->tracing) return;
    put_format(&a->lines, "{\"t\":%s,\"command\":\"revoke\",\"request\":{\"command\":\"revoke\",\"revocation\":\"",
               a->t);
    put_base64(&a->lines, body, n);
    put_text(&a->lines, "\"");
    if (from != 0)
        put_format(&a->lines, ",\"from\":%u", from);
    put_text(&a->lines, "}}\n");
}

/* The same with keys: what is authentic is read as if it had come in plain. */
static void take_sealed(Agent *a, double now, const uint8_t *datagram, size_t n) {
    Input in = {0};
    Opened opened = {0};
    Buf plain = {0};
    enum drop drop = keys_open(a, now, datagram, n, &plain, &opened);
    if (drop == GOOD && opened.type >= REVOCATION) {
        if (opened.type == REVOCATION)
            note_revocation(a, plain.data, plain.len, opened.sender);
    } else {
        if (drop == GOOD)
            drop = keys_allow(a, now, &opened, &in, read_datagram(a, plain.data, plain.len, &in));
        if (drop == GOOD) {
            run_all(a, MESSAGES[in.type].algorithm, BY_MESSAGE, 0, &in);
            keys_keep(a, &opened, &in);
        } else {
            drop_datagram(a, drop, datagram, n);
        }
    }
    keys_seal(a, &opened);
    free(plain.data);
}

static void take_datagram(Agent *a, double now, const uint8_t *datagram, size_t n) {
    Input in;
    begin_input(a, now);
    if (a->keys != NULL) {
        take_sealed(a, now, datagram, n);
        return;
    }
    enum drop drop = read_datagram(a, datagram, n, &in);
    if (drop == GOOD)
        run_all(a, MESSAGES[in.type].algorithm, BY_MESSAGE, 0, &in);
    else
        drop_datagram(a, drop, datagram, n);
}

static void seal_all(Agent *a) {                        /* what an input that is no datagram has it send */
    if (a->keys != NULL)
        keys_seal(a, NULL);
}

/* The command; NULL, or why not. One that is known already is no error. */
static const char *take_revocation(Agent *a, double now, const uint8_t *body, size_t n) {
    begin_input(a, now);
    enum drop drop = keys_revoke(a, now, body, n);
    if (drop == GOOD)
        note_revocation(a, body, n, 0);
    seal_all(a);
    return drop == GOOD || drop == KNOWN_ALREADY ? NULL : "The authority does not say so.";
}

static bool event_fits(const Agent *a, size_t n) { return EVENT_HEADER + n <= a->m.settings.max_event_bytes; }

static void take_event(Agent *a, double now, uint8_t event_id, uint64_t timestamp, const uint8_t *data, size_t n) {
    uint8_t event[MAX_EVENT_DATA];
    begin_input(a, now);
    if (a->no_events) return;
    write_be(event, timestamp, 8);
    event[8] = event_id;
    write_be(event + 9, n, 2);
    if (n > 0)
        memcpy(event + EVENT_HEADER, data, n);
    Input in = {.raw = event, .raw_len = EVENT_HEADER + n, .timestamp = timestamp};
    run_all(a, 1, BY_EVENT, event_id, &in);
    seal_all(a);
}

/* The timer whose turn it is: of those that have come the earliest, those started during this very input last. */
static enum timer timer_that_came(const Agent *a) {
    enum timer first = NO_TIMER;
    for (int i = 0; i < TIMERS; i++) {
        if (!a->timer[i].runs || a->timer[i].deadline > a->now) continue;
        bool late = a->timer[i].since == a->inputs;
        if (first == NO_TIMER || late < (a->timer[first].since == a->inputs)
            || (late == (a->timer[first].since == a->inputs) && a->timer[i].deadline < a->timer[first].deadline))
            first = (enum timer)i;
    }
    return first;
}

static void take_timers(Agent *a, double now) {
    begin_input(a, now);
    for (enum timer i; (i = timer_that_came(a)) != NO_TIMER;) {
        a->timer[i].runs = false;
        run_all(a, TIMER[i].algorithm, BY_TIMER, (uint64_t)i, NULL);
    }
    seal_all(a);
}

static double next_deadline(const Agent *a) {           /* infinity if no timer runs and no answer waits */
    size_t place;
    double first = next_answer(a, &place);
    for (int i = 0; i < TIMERS; i++)
        if (a->timer[i].runs && a->timer[i].deadline < first)
            first = a->timer[i].deadline;
    return first;
}

static void take_reconcile(Agent *a, double now) {
    begin_input(a, now);
    run_all(a, RECONCILE_BEGIN, BY_OPERATOR, 0, NULL);
    seal_all(a);
}

/* A command that runs no handler leaves a line of its own. */
static void note_command(Agent *a, double now, Json *j, uint32_t request, const char *command, const char *without) {
    begin_input(a, now);
    if (!a->tracing) return;
    put_format(&a->lines, "{\"t\":%s,\"command\":\"%s\",\"request\":", a->t, command);
    put_object(&a->lines, j, request, without);
    put_text(&a->lines, "}\n");
}

/* An agent as it is at first; the memory that an earlier life had is used again. */
static void agent_new(Agent *a) {
    set_clear(&a->roster);
    for (size_t i = 0; i < a->m.roster_len; i++)
        set_add(&a->roster, a->m.roster[i]);
    a->candidates = grow(a->candidates, a->m.roster_len * sizeof *a->candidates);
    a->bh0 = H(a->m.initial_data.data, a->m.initial_data.len);
    a->top = a->ch0 = H(a->bh0.b, 32);
    list_clear(&a->chain);
    list_clear(&a->deque);
    list_clear(&a->stack);
    a->current_len = a->completed.len = a->candidates_len = a->local_len = 0;
    a->has_newest = a->reconciling = a->has_majority = a->started = a->no_events = a->boots = false;
    a->reconciles = a->handled = a->bytes_sent = a->send_failures = 0;
    memset(a->timer, 0, sizeof a->timer);
    memset(a->dropped, 0, sizeof a->dropped);
    a->sequence = 0;
    a->out.len = a->waiting.len = a->lines.len = a->journal.len = a->changes.len = a->sent.len = 0;
    set_clear(&a->voters);
    set_clear(&a->responders);
    keys_free(a);
}

/* An agent that found a store goes on as if nobody had answered its reconcile: Algorithm 20. */
static void boot(Agent *a, double now) {
    Buf found = {0};
    const List *lists[] = {&a->chain, &a->deque, &a->stack};
    const enum change changes[] = {CHAIN_PUSH, DEQUE_PUSH, STACK_PUSH};
    begin_input(a, now);
    if (a->keys != NULL)
        keys_boot(a);
    a->reconciling = true;
    for (size_t i = 0; i < completed_len(a); i++)
        put_change(&a->changes, COMPLETE, a->completed.data + 32 * i);
    for (int k = 0; k < 3; k++)
        for (size_t i = 0; i < lists[k]->len; i++) {
            const Block *block = lists[k]->at[i];
            put_change(&a->changes, changes[k], block->hash.b);
            put_be(&found, block->size, 2);
            put(&found, block->data, block->size);
            if ((!a->has_newest || block->timestamp > a->newest) && has_completed(a, block)) {
                a->has_newest = true;
                a->newest = block->timestamp;
            }
        }
    Input in = {.raw = found.data, .raw_len = found.len};
    run_all(a, RECONCILE_FINALIZE, BY_BOOT, a->chain.len, &in);
    seal_all(a);
    free(found.data);
}

/* ================================================================================================================
 * 8  What an agent tells: trace header, status, chain export; and timestamps
 * ============================================================================================================= */

static uint64_t timestamp_at(const Agent *a, double now) {   /* microseconds, never below 0 nor above 2^64 - 1 */
    double us = rint(now * 1e6);
    if (us < 0) return -us >= (double)a->m.epoch_us ? 0 : a->m.epoch_us - (uint64_t)-us;
    return us >= 9.2e18 ? UINT64_MAX : a->m.epoch_us + (uint64_t)us;
}

static void put_header(Buf *b, const Agent *a) {
    const Settings *s = &a->m.settings;
    put_format(b, "{\"schema\":\"ucp-trace/2\",\"agent_id\":%u,\"roster\":[", a->m.agent_id);
    for (size_t i = 0; i < a->m.roster_len; i++)
        put_format(b, "%s%u", i > 0 ? "," : "", a->m.roster[i]);
    put_text(b, "],\"initial_data\":\"");
    put_base64(b, a->m.initial_data.data, a->m.initial_data.len);
    put_format(b, "\",\"settings\":{\"vote_timeout_s\":%.17g,\"phase1_timeout_s\":%.17g,\"phase2_timeout_s\":%.17g,"
               "\"phase3_timeout_s\":%.17g,\"finalize_gap_s\":%.17g,", s->vote_timeout, s->phase1_timeout,
               s->phase2_timeout, s->phase3_timeout, s->finalize_gap);
    put_format(b, "\"max_block_bytes\":%" PRIu64 ",\"max_event_bytes\":%" PRIu64 ",\"vote_names_chain\":%s,"
               "\"changed_before_tally\":%s,%s%s\"phase1_tie\":\"%s\",\"phase2_tie\":\"%s\"", s->max_block_bytes,
               s->max_event_bytes, truth(s->vote_names_chain), truth(s->changed_before_tally),
               s->asks_after_commit ? "\"asks_after_commit\":true," : "",
               s->top_needs_majority ? "\"top_needs_majority\":true," : "", s->phase1_tie_pop ? "pop" : "phase2",
               s->phase2_tie_block ? "block" : "oldest");
    if (s->answer_spread > 0)
        put_format(b, ",\"answer_spread_s\":%.17g", s->answer_spread);
    put_format(b, "},\"clock\":{\"epoch_us\":%" PRIu64 ",\"speedup\":%.17g}%s}\n", a->m.epoch_us, a->m.speedup,
               a->keys != NULL ? ",\"secured\":true" : "");
}

static void put_status(Buf *b, const Agent *a, double now, const char *trace_problem) {
    put_format(b, "{\"ok\":true,\"version\":\"ucp_agent.c, 1\",\"started\":%s,\"idle\":%s,\"reconcile_in_progress\":%s",
               truth(a->started), truth(is_idle(a)), truth(a->reconciling));
    put_format(b, ",\"chain\":%zu,\"deque\":%zu,\"stack\":%zu,\"completed\":%zu,\"reconciles\":%" PRIu64, a->chain.len,
               a->deque.len, a->stack.len, completed_len(a), a->reconciles);
    put_text(b, ",\"top_chain_hash\":\"");
    put_hex(b, a->top.b, 32);
    put_format(b, "\",\"handled\":%" PRIu64 ",\"bytes_sent\":%" PRIu64 ",\"send_failures\":%" PRIu64 ",\"dropped\":{",
               a->handled, a->bytes_sent, a->send_failures);
    const char *comma = "";
    for (int i = 0; i < DROPS; i++)
        if (a->dropped[i] > 0) {
            put_format(b, "%s\"%s\":%" PRIu64, comma, DROP[i], a->dropped[i]);
            comma = ",";
        }
    put_format(b, "},\"trace_problem\":%s%s%s", trace_problem != NULL ? "\"" : "",
               trace_problem != NULL ? trace_problem : "null", trace_problem != NULL ? "\"" : "");
    if (a->started)
        put_format(b, ",\"mission_s\":%.17g", now);
    put_byte(b, '}');
}

static void put_blocks(Buf *b, Agent *a, const char *name, const List *list, bool in_chain) {
    put_format(b, ",\"%s\":[", name);
    for (size_t i = 0; i < list->len; i++) {
        const Block *block = list->at[i];
        put_format(b, "%s{\"agent_id\":%u,\"timestamp_us\":%" PRIu64 ",\"event_data\":\"", i > 0 ? "," : "",
                   block->agent, block->timestamp);
        put_base64(b, block->data + BLOCK_HEADER, block->size - (size_t)BLOCK_HEADER);
        put_text(b, "\",\"block_hash\":\"");
        put_hex(b, block->hash.b, 32);
        const uint8_t *signature = a->keys != NULL ? keys_signature(a, block->data, block->size) : NULL;
        if (signature != NULL) {
            put_text(b, "\",\"signature\":\"");
            put_base64(b, signature, 64);
        }
        put_text(b, in_chain ? "\",\"chain_hash\":\"" : "\",\"chain_hash\":null}");
        if (in_chain) {
            put_hex(b, block->chain.b, 32);
            put_text(b, "\"}");
        }
    }
    put_byte(b, ']');
}

static void put_hashes(Buf *b, const Agent *a) {        /* of `completed` */
    put_text(b, ",\"completed\":[");
    for (size_t i = 0; i < completed_len(a); i++) {
        put_text(b, i > 0 ? ",\"" : "\"");
        put_hex(b, a->completed.data + 32 * i, 32);
        put_byte(b, '"');
    }
    put_byte(b, ']');
}

static void put_export(Buf *b, Agent *a, uint64_t exported_at) {
    put_format(b, "{\"schema\":\"ucp-chain-export/1\",\"agent_id\":%u,\"exported_at_us\":%" PRIu64
               ",\"inception\":{\"block_data\":\"", a->m.agent_id, exported_at);
    put_base64(b, a->m.initial_data.data, a->m.initial_data.len);
    put_text(b, "\",\"block_hash\":\"");
    put_hex(b, a->bh0.b, 32);
    put_text(b, "\",\"chain_hash\":\"");
    put_hex(b, a->ch0.b, 32);
    put_text(b, "\"}");
    put_blocks(b, a, "chain", &a->chain, true);
    put_blocks(b, a, "blocks_to_be_committed", &a->deque, false);
    put_blocks(b, a, "reconcile_stack", &a->stack, false);
    put_text(b, ",\"current_block\":{\"event_data\":\"");
    put_base64(b, a->current, a->current_len);
    put_format(b, "\"},\"reconcile_in_progress\":%s,\"idle\":%s", truth(a->reconciling),
               truth(is_idle(a)));
    put_hashes(b, a);
    if (a->keys != NULL)
        put_head(b, a, exported_at);
    put_byte(b, '}');
}

/* The answer to a command that failed, or that this agent does not have. */
static void put_error(Buf *b, bool unsupported, const char *error) {
    put_format(b, "{\"ok\":false,%s\"error\":\"%s\"}", unsupported ? "\"unsupported\":true," : "", error);
}

/* ================================================================================================================
 * 9  The store: a file that begins with agent and mission, and has a record for each input that changed anything
 * ============================================================================================================= */

/* record    length u32 || changes (length bytes) || the first 8 bytes of H(changes)
   change    what u8, then: complete, stack-: block hash; chain+, deque+, stack+: length u16 || BD; others: nothing
             with keys also: its maker's signature of a block; when a life began; a revocation */

static void put_store_header(Buf *b, const Agent *a) {
    put(b, "UCP store of ucp_agent.c, 1\n", 28);
    put_be(b, a->m.agent_id, 4);
    put(b, a->bh0.b, 32);
}

static bool store_replay(Agent *a, const uint8_t *at, const uint8_t *end) {
    while (at < end) {
        enum change what = (enum change)*at++;
        Block *block = NULL;
        if (what >= CHANGES && a->keys != NULL) {
            size_t n = keys_replay(a, what, at, (size_t)(end - at));
            if (n == 0) return false;
            at += n;
            continue;
        }
        if (what == CHAIN_PUSH || what == DEQUE_PUSH || what == STACK_PUSH) {
            if (end - at < 2 || end - at - 2 < (ptrdiff_t)read_be(at, 2) || !block_well_formed(at + 2, read_be(at, 2)))
                return false;
            block = block_new(at + 2, read_be(at, 2));
            at += 2 + block->size;
            if (what == CHAIN_PUSH)
                chain_push(a, block);
            else
                list_push(what == DEQUE_PUSH ? &a->deque : &a->stack, block);
            continue;
        }
        if (what == CHAIN_POP) {
            if (a->chain.len == 0) return false;
            block = chain_pop(a);
        } else if (what == DEQUE_POP) {
            if (a->deque.len == 0) return false;
            block = list_take(&a->deque, 0);
        } else {
            Hash hash;
            if ((what != COMPLETE && what != STACK_TAKE) || end - at < 32) return false;
            memcpy(hash.b, at, 32);
            at += 32;
            if (what == COMPLETE) {
                put(&a->completed, hash.b, 32);
                continue;
            }
            ptrdiff_t i = list_find(&a->stack, &hash);
            if (i < 0) return false;
            block = list_take(&a->stack, (size_t)i);
        }
        free(block);
    }
    return true;
}

static size_t store_read(Agent *a, const uint8_t *bytes, size_t at, size_t n) {   /* returns how much of it is good */
    while (n - at >= 12) {
        size_t size = (size_t)read_be(bytes + at, 4);
        if (n - at - 12 < size) break;
        Hash hash = H(bytes + at + 4, size);
        if (memcmp(hash.b, bytes + at + 4 + size, 8) != 0 || !store_replay(a, bytes + at + 4, bytes + at + 4 + size))
            break;
        at += 12 + size;
    }
    return at;
}

static bool write_all(int fd, const uint8_t *bytes, size_t n) {
    for (ssize_t written; n > 0; bytes += written, n -= (size_t)written)
        if ((written = write(fd, bytes, n)) < 0) {
            if (errno != EINTR) return false;
            written = 0;
        }
    return true;
}

static bool read_file(const char *path, size_t limit, Buf *b) {   /* at most a byte more than the limit */
    int fd = open(path, O_RDONLY | O_CLOEXEC);
    ssize_t n = fd < 0 ? -1 : 1;
    while (n > 0 && b->len <= limit)
        if ((n = read(fd, buf_room(b, 65536), 65536)) > 0)
            b->len += (size_t)n;
        else if (n < 0 && errno == EINTR)
            n = 1;
    if (fd >= 0)
        close(fd);
    return n >= 0;
}

/* The file is there whole, or it is as it was before. */
static bool replace_file(const char *path, const Buf *content, mode_t mode) {
    char new[4096];
    if ((size_t)snprintf(new, sizeof new, "%s.new", path) >= sizeof new) return errno = ENAMETOOLONG, false;
    int fd = open(new, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, mode);
    if (fd < 0) return false;
    bool good = write_all(fd, content->data, content->len) && fsync(fd) == 0;
    int error = errno;
    if (close(fd) == 0 && good && rename(new, path) == 0) return true;
    errno = good ? errno : error;
    error = errno;
    unlink(new);
    return errno = error, false;
}

/* ================================================================================================================
 * 10  An agent over UDP: its files, its clock, its sockets
 * ============================================================================================================= */

typedef struct { int fd; Buf in, out; size_t given; bool ended; } Client;      /* given: how much of `out` is sent */

typedef struct {
    Agent *a;
    int udp, listener, trace, store;                    /* file descriptors, -1 if there is none */
    off_t trace_end, store_end;                         /* up to where these files are good */
    const char *trace_problem;
    double wall0, mono0;
    uint64_t random;                                    /* state of the generator */
    double next_second;                                 /* when Algorithm 21 draws again */
    char export_name[32], control_name[32];
    Client client[MAX_CLIENTS];
    int clients;
    Json json;
    Buf bytes;
    Json bundle;                                        /* its keys as they were read, over `keys` */
    Buf keys;
} Station;

static double seconds(clockid_t clock) {
    struct timespec time;
    clock_gettime(clock, &time);
    return (double)time.tv_sec + (double)time.tv_nsec / 1e9;
}

static double since_epoch(const Station *s) {           /* mission seconds, below 0 before the mission's epoch */
    return (s->wall0 - (double)s->a->m.epoch_us / 1e6 + seconds(CLOCK_MONOTONIC) - s->mono0) * s->a->m.speedup;
}

static double mission_now(const Station *s) { return fmax(s->a->now, since_epoch(s)); }        /* never goes back */

/* --- Trace ------------------------------------------------------------------------------------------------------- */

static bool trace_open(Station *s, const char *name) {
    char last = '\0';
    s->trace = open(name, O_RDWR | O_CREAT | O_APPEND | O_CLOEXEC, 0666);
    s->trace_end = s->trace < 0 ? -1 : lseek(s->trace, 0, SEEK_END);
    off_t end = s->trace_end;                           /* half a line that an earlier life left is cut away */
    while (s->trace_end > 0 && pread(s->trace, &last, 1, s->trace_end - 1) == 1 && last != '\n')
        s->trace_end--;
    return end >= 0 && (end == s->trace_end || ftruncate(s->trace, s->trace_end) == 0);
}

static void trace_write(Station *s) { /* each line in one write; a full disk ends it at a whole line */
    Buf *lines = &s->a->lines;
    for (size_t at = 0; at < lines->len && s->trace >= 0;) {
        const uint8_t *line = lines->data + at;
        size_t n = (size_t)((const uint8_t *)memchr(line, '\n', lines->len - at) - line) + 1;
        if (write_all(s->trace, line, n)) {
            s->trace_end += (off_t)n;
            at += n;
            continue;
        }
        s->trace_problem = errno == ENOSPC || errno == EDQUOT ? "The disk is full." : "The trace cannot be written.";
        fprintf(stderr, "The trace ends here: %s.\n", strerror(errno));
        if (ftruncate(s->trace, s->trace_end) != 0)
            fprintf(stderr, "Half a line cannot be cut off the trace: %s.\n", strerror(errno));
        close(s->trace);
        s->trace = -1;
        s->a->tracing = false;
    }
    lines->len = 0;
}

/* --- Store ------------------------------------------------------------------------------------------------------- */

static void sync_folder(const char *path) {             /* so that a file that was renamed is found after a brown-out */
    char folder[4096];
    const char *slash = strrchr(path, '/');
    snprintf(folder, sizeof folder, "%.*s", slash != NULL ? (int)(slash - path + 1) : 1, slash != NULL ? path : ".");
    int fd = open(folder, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (fd >= 0) {
        fsync(fd);
        close(fd);
    }
}

static bool store_open(Station *s) {                    /* reads what is there, or begins a new one */
    Agent *a = s->a;
    Buf file = {0}, header = {0};
    bool good = true;
    put_store_header(&header, a);
    s->store_end = (off_t)header.len;
    if (!read_file(a->m.store, SIZE_MAX / 2, &file) && errno != ENOENT) {
        fprintf(stderr, "The store cannot be read: %s.\n", strerror(errno));
        good = false;
    } else if (file.len == 0) {                         /* none, or an empty one */
        good = replace_file(a->m.store, &header, 0666);
        if (good)
            sync_folder(a->m.store);
        else
            fprintf(stderr, "The store cannot be written: %s.\n", strerror(errno));
    } else if (file.len < header.len || memcmp(file.data, header.data, header.len) != 0) {
        fprintf(stderr, "The store is none of this agent and this mission.\n");
        good = false;
    } else {
        s->store_end = (off_t)store_read(a, file.data, header.len, file.len);
        a->boots = true;
    }
    if (good) {
        s->store = open(a->m.store, O_WRONLY | O_APPEND | O_CLOEXEC);
        good = s->store >= 0 && ftruncate(s->store, s->store_end) == 0;
        if (!good)
            fprintf(stderr, "The store cannot be opened: %s.\n", strerror(errno));
    }
    free(file.data);
    free(header.data);
    a->keeping = good;
    return good;
}

static void store_write(Station *s) {
    Agent *a = s->a;
    if (a->journal.len == 0) return;
    Hash hash = H(a->journal.data, a->journal.len);
    s->bytes.len = 0;
    put_be(&s->bytes, a->journal.len, 4);
    put(&s->bytes, a->journal.data, a->journal.len);
    put(&s->bytes, hash.b, 8);
    a->journal.len = 0;
    if (write_all(s->store, s->bytes.data, s->bytes.len) && fsync(s->store) == 0) {
        s->store_end += (off_t)s->bytes.len;
        return;
    }
    fprintf(stderr, "The store ends here, and the agent goes on without it: %s.\n", strerror(errno));
    if (ftruncate(s->store, s->store_end) != 0)
        fprintf(stderr, "Its end cannot be cut off: %s.\n", strerror(errno));
    close(s->store);
    s->store = -1;
    a->keeping = false;
}

/* --- Keys -------------------------------------------------------------------------------------------------------- */

static bool bundle_read(Station *s, Fault *fault) {
    Agent *a = s->a;
    struct stat about;
    struct timespec time;
    uint8_t life[BOOT];
    clock_gettime(CLOCK_REALTIME, &time);
    write_be(life, (uint64_t)time.tv_sec * 1000000 + (uint64_t)time.tv_nsec / 1000, 8);
    if (getrandom(life + 8, 8, 0) != 8) return fail(fault, STATUS_WRONG, "No random numbers can be had.");
    if (stat(a->m.bundle, &about) != 0 || !read_file(a->m.bundle, MAX_BUNDLE, &s->keys))
        return fail(fault, STATUS_WRONG, "The bundle cannot be read: %s.", strerror(errno));
    if ((about.st_mode & 077) != 0) return fail(fault, STATUS_WRONG, "Others can read the bundle: chmod 600 it.");
    put_byte(&s->keys, '\0');
    if (s->keys.len - 1 > MAX_BUNDLE || !json_parse(&s->bundle, (char *)s->keys.data, s->keys.len - 1))
        return fail(fault, STATUS_WRONG, "The bundle is too large, or no JSON.");
    if (!keys_read(a, &s->bundle, ROOT, life, fault)) return false;
    keys_begin(a);
    return true;
}

static void bundle_write(Station *s) {                  /* without the secrets of epochs that are over */
    Buf anew = {0};
    put_bundle(&anew, &s->bundle, ROOT, s->a->keys);
    if (!replace_file(s->a->m.bundle, &anew, 0600))
        fprintf(stderr, "The group's last secret is still on disk: %s.\n", strerror(errno));
    free(anew.data);
}

/* --- What follows an input: store, trace, messages, in this order. ----------------------------------------------- */

static void settle(Station *s) {
    Agent *a = s->a;
    struct sockaddr_in to = {.sin_family = AF_INET, .sin_port = htons(a->m.port), .sin_addr = a->m.broadcast};
    if (a->keys != NULL && keys_moved(a))
        bundle_write(s);
    store_write(s);
    trace_write(s);
    hold_answers(a);
    for (size_t at = 0; at < a->out.len;) {
        size_t n = (size_t)read_be(a->out.data + at, 2);
        if (sendto(s->udp, a->out.data + at + 2, n, 0, (struct sockaddr *)&to, sizeof to) == (ssize_t)n)
            a->bytes_sent += n;
        else
            a->send_failures++;
        at += 2 + n;
    }
    a->out.len = 0;
}

static uint64_t draw(Station *s) {                      /* SplitMix64 */
    uint64_t z = s->random += 0x9e3779b97f4a7c15u;
    z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
    z = (z ^ z >> 27) * 0x94d049bb133111ebu;
    return z ^ z >> 31;
}

static double draw_part(Station *s) { return (double)(draw(s) >> 11) * 0x1p-53; }      /* of 0..1 */

static void begin_mission(Station *s, uint64_t epoch_us) {
    Agent *a = s->a;
    a->m.epoch_us = epoch_us;
    s->wall0 = seconds(CLOCK_REALTIME);
    s->mono0 = seconds(CLOCK_MONOTONIC);
    a->now = 0;
    a->now = mission_now(s);
    a->started = a->tracing = true;
    put_header(&a->lines, a);
    if (a->boots)
        boot(a, a->now);
    if (a->keys != NULL && a->keeping)
        put_lived(&a->journal, a->keys);
    settle(s);
    s->random = a->m.seed;
    s->next_second = a->m.random_events ? a->now + draw_part(s) : INFINITY;
}

/* --- Events: Algorithm 21 ---------------------------------------------------------------------------------------- */

static void random_events(Station *s, double now) {     /* the seconds that have come since it was here last */
    Agent *a = s->a;
    if (now - s->next_second > 1000)                    /* it was stopped for long: nothing happened meanwhile */
        s->next_second = now + draw_part(s);
    while (s->next_second <= now) {
        s->next_second += 1;
        if (draw_part(s) >= 1 / fmax(1, a->m.mean_s)) continue;
        uint8_t data[256], event_id = (uint8_t)(1 + draw(s) % 254);
        size_t n = (size_t)32 << (draw(s) >> 62);
        for (size_t i = 0; i < n; i += 8)
            write_be(data + i, draw(s), 8);
        if (a->no_events) continue;
        if (event_fits(a, n)) {
            take_event(a, now, event_id, timestamp_at(a, now), data, n);
            settle(s);
        } else {
            fprintf(stderr, "An event of %zu bytes is too large and not logged.\n", EVENT_HEADER + n);
        }
    }
}

static void tick(Station *s) {                          /* all that time alone brings */
    if (!s->a->started) return;
    double now = mission_now(s);
    if (next_deadline(s->a) <= now) {
        take_timers(s->a, now);
        settle(s);
    }
    if (s->next_second <= now)
        random_events(s, now);
}

/* --- Control socket ---------------------------------------------------------------------------------------------- */

static bool export_chain(Station *s) {
    Agent *a = s->a;
    s->bytes.len = 0;
    put_export(&s->bytes, a, a->started ? timestamp_at(a, mission_now(s)) : 0);
    put_byte(&s->bytes, '\n');
    if (replace_file(s->export_name, &s->bytes, 0666)) return true;
    fprintf(stderr, "The chain export cannot be written: %s.\n", strerror(errno));
    return false;
}

static void answer(Station *s, uint32_t request, Buf *b) {
    Agent *a = s->a;
    Json *j = &s->json;
    uint32_t command = member(j, request, "command");
    bool stop = says(j, command, "stop_events"), export = says(j, command, "export");
    const char *error = NULL;
    uint64_t value;
    if (says(j, command, "status")) {
        put_status(b, a, a->started ? mission_now(s) : 0, s->trace_problem);
        return;
    }
    if (says(j, command, "start")) {
        error = a->started ? "The mission has begun."
              : !json_uint(j, member(j, request, "epoch_us"), 0, INT64_MAX, &value) ? "epoch_us is no time." : NULL;
        if (error == NULL)
            begin_mission(s, value);
    } else if (says(j, command, "log")) {
        Buf data = {0};
        error = !a->started ? "The mission has not begun."
              : !json_uint(j, member(j, request, "event_id"), 1, 254, &value)
                || !json_bytes(j, member(j, request, "data"), &data) ? "This is no event."
              : !event_fits(a, data.len) ? "The event is too large." : NULL;
        double now = mission_now(s);
        if (error == NULL)
            take_event(a, now, (uint8_t)value, timestamp_at(a, now), data.data, data.len);
        free(data.data);
    } else if (says(j, command, "reconcile")) {
        error = a->started ? NULL : "The mission has not begun.";
        if (error == NULL)
            take_reconcile(a, mission_now(s));
    } else if (a->keys != NULL && says(j, command, "revoke")) {
        Buf body = {0};
        error = !a->started ? "The mission has not begun."
              : !json_bytes(j, member(j, request, "revocation"), &body) ? "This is no revocation."
              : take_revocation(a, mission_now(s), body.data, body.len);
        free(body.data);
    } else if (stop || export) {
        a->no_events = a->no_events || stop;
        error = export && !export_chain(s) ? "The export could not be written." : NULL;
        if (error == NULL && a->started)
            note_command(a, mission_now(s), j, request, stop ? "stop_events" : "export", NULL);
    } else {
        put_error(b, true, "This agent does not have the command.");
        return;
    }
    settle(s);
    if (error != NULL)
        put_error(b, false, error);
    else if (export)
        put_format(b, "{\"ok\":true,\"path\":\"%s\"}", s->export_name);
    else
        put_text(b, "{\"ok\":true}");
}

static void client_close(Station *s, int i) {
    close(s->client[i].fd);
    free(s->client[i].in.data);
    free(s->client[i].out.data);
    s->client[i] = s->client[--s->clients];
}

/* Take requests that are there, give the answers that go; false: the connection is over. A client that does not take
   its answers is not read from meanwhile; one that never stops asking waits for others now and then. */
static bool client_serve(Station *s, Client *c) {
    if (!c->ended && c->in.len <= MAX_REQUEST) {
        ssize_t n = recv(c->fd, buf_room(&c->in, MAX_REQUEST), MAX_REQUEST, 0);
        if (n < 0 && errno != EAGAIN && errno != EWOULDBLOCK) return false;
        c->ended = n == 0;                              /* half a line at the end is no request */
        c->in.len += n > 0 ? (size_t)n : 0;
    }
    for (;;) {
        size_t at = 0;
        const char *line = (const char *)c->in.data, *end = NULL;
        while (c->out.len < (1 << 20) && at < c->in.len && (end = memchr(line + at, '\n', c->in.len - at)) != NULL) {
            size_t n = (size_t)(end - line) - at;
            if (n > MAX_REQUEST) return false;
            c->in.data[at + n] = '\0';
            if (json_parse(&s->json, line + at, n) && kind(&s->json, ROOT) == '{')
                answer(s, ROOT, &c->out);
            else
                put_error(&c->out, false, "not JSON");
            put_byte(&c->out, '\n');
            at += n + 1;
            tick(s);
        }
        if (at > 0)
            buf_drop(&c->in, at);
        while (c->given < c->out.len) {
            ssize_t n = send(c->fd, c->out.data + c->given, c->out.len - c->given, MSG_NOSIGNAL);
            if (n < 0) return errno == EAGAIN || errno == EWOULDBLOCK;
            c->given += (size_t)n;
        }
        c->given = c->out.len = 0;
        if (at == 0)                                    /* no whole line is left, but maybe too long a beginning */
            return !c->ended && c->in.len <= MAX_REQUEST;
    }
}

static bool control_open(Station *s) {
    struct sockaddr_un name = {.sun_family = AF_UNIX};
    snprintf(name.sun_path, sizeof name.sun_path, "%s.new", s->control_name);
    unlink(name.sun_path);
    s->listener = socket(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    return s->listener >= 0 && bind(s->listener, (struct sockaddr *)&name, sizeof name) == 0
        && listen(s->listener, 64) == 0 && rename(name.sun_path, s->control_name) == 0;
}

static bool udp_open(Station *s) {
    int yes = 1, room = 4 << 20;
    struct sockaddr_in name = {.sin_family = AF_INET, .sin_port = htons(s->a->m.port)};
    s->udp = socket(AF_INET, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (s->udp < 0) return false;
    setsockopt(s->udp, SOL_SOCKET, SO_RCVBUF, &room, sizeof room);     /* as much as is allowed */
    setsockopt(s->udp, SOL_SOCKET, SO_SNDBUF, &room, sizeof room);
    return setsockopt(s->udp, SOL_SOCKET, SO_BROADCAST, &yes, sizeof yes) == 0
        && bind(s->udp, (struct sockaddr *)&name, sizeof name) == 0;
}

static void udp_receive(Station *s) {                   /* some of what is there: timers and commands have their turn */
    static uint8_t datagram[65536];
    for (int i = 0; i < 64; i++) {
        struct sockaddr_in from = {0};
        socklen_t size = sizeof from;
        ssize_t n = recvfrom(s->udp, datagram, sizeof datagram, 0, (struct sockaddr *)&from, &size);
        if (n < 0) return;
        if (!s->a->started || from.sin_addr.s_addr == s->a->m.address.s_addr)
            continue;                                   /* not yet; its own echo */
        take_datagram(s->a, mission_now(s), datagram, (size_t)n);
        settle(s);
        tick(s);
    }
}

static struct timespec time_to_wait(const Station *s) {   /* until the next timer or event, at most a minute */
    double wait = 60;
    if (s->a->started) {
        double at = fmin(next_deadline(s->a), s->next_second);
        wait = fmax(0, fmin(wait, (at - since_epoch(s)) / s->a->m.speedup));
    }
    long ns = (long)((wait - floor(wait)) * 1e9) + 1000;
    return (struct timespec){(time_t)wait + ns / 1000000000, ns % 1000000000};
}

static void station_run(Station *s, int signals) {      /* until SIGTERM or SIGINT */
    struct pollfd polled[3 + MAX_CLIENTS] = {{signals, POLLIN, 0}, {s->udp, POLLIN, 0}};
    for (;;) {
        tick(s);
        int clients = s->clients;
        polled[2] = (struct pollfd){s->clients < MAX_CLIENTS ? s->listener : -1, POLLIN, 0};
        for (int i = 0; i < clients; i++)
            polled[3 + i] = (struct pollfd){s->client[i].fd, s->client[i].out.len > 0 ? POLLOUT : POLLIN, 0};
        struct timespec wait = time_to_wait(s);
        if (ppoll(polled, 3 + (nfds_t)clients, &wait, NULL) < 0) continue;
        if (polled[0].revents != 0) return;
        if (polled[1].revents != 0)
            udp_receive(s);
        for (int i = clients - 1; i >= 0; i--)          /* closing one moves the last one, which has been served */
            if (polled[3 + i].revents != 0 && !client_serve(s, &s->client[i]))
                client_close(s, i);
        int fd = polled[2].revents != 0 ? accept4(s->listener, NULL, NULL, SOCK_NONBLOCK | SOCK_CLOEXEC) : -1;
        if (fd >= 0)
            s->client[s->clients++] = (Client){.fd = fd};
    }
}

static int play_over_udp(Agent *a, const char *mission_file) {
    static Station station = {.udp = -1, .listener = -1, .trace = -1, .store = -1};
    Station *s = &station;
    Fault fault;
    char trace_name[32];
    sigset_t ends;
    sigemptyset(&ends);
    sigaddset(&ends, SIGTERM);
    sigaddset(&ends, SIGINT);
    sigprocmask(SIG_BLOCK, &ends, NULL);                /* they interrupt nothing: the loop looks for them */
    int signals = signalfd(-1, &ends, SFD_CLOEXEC);
    signal(SIGPIPE, SIG_IGN);
    signal(SIGXFSZ, SIG_IGN);

    s->a = a;
    if (!read_file(mission_file, MAX_MISSION, &s->bytes)) {
        fprintf(stderr, "The mission file cannot be read: %s.\n", strerror(errno));
        return STATUS_WRONG;
    }
    put_byte(&s->bytes, '\0');
    if (s->bytes.len - 1 > MAX_MISSION || !json_parse(&s->json, (char *)s->bytes.data, s->bytes.len - 1)) {
        fprintf(stderr, "The mission file is too large, or no JSON.\n");
        return STATUS_WRONG;
    }
    if (!mission_read(&a->m, &s->json, ROOT, &fault)) {
        fprintf(stderr, "%s\n", fault.text);
        return fault.status;
    }
    agent_new(a);
    if (a->m.bundle != NULL && !bundle_read(s, &fault)) {
        fprintf(stderr, "%s\n", fault.text);
        return fault.status;
    }
    snprintf(s->export_name, sizeof s->export_name, "%u.chain.json", a->m.agent_id);
    snprintf(s->control_name, sizeof s->control_name, "%u.control", a->m.agent_id);
    snprintf(trace_name, sizeof trace_name, "%u.trace.jsonl", a->m.agent_id);
    if (a->m.store != NULL && !store_open(s)) return STATUS_WRONG;
    const char *missing = !trace_open(s, trace_name) ? "trace" : !udp_open(s) ? "UDP port"
                        : !control_open(s) ? "control socket" : NULL;
    if (missing != NULL) {
        fprintf(stderr, "The %s cannot be had: %s.\n", missing, strerror(errno));
        return STATUS_WRONG;
    }
    if (a->m.has_epoch)
        begin_mission(s, a->m.epoch_us);
    station_run(s, signals);
    bool exported = export_chain(s);
    unlink(s->control_name);
    while (s->clients > 0)
        client_close(s, 0);
    void *const all[] = {s->bytes.data, s->json.node, s->json.scratch.data, s->keys.data, s->bundle.node,
                         s->bundle.scratch.data};
    for (size_t i = 0; i < sizeof all / sizeof *all; i++)
        free(all[i]);
    return exported ? 0 : 1;
}

/* ================================================================================================================
 * 11  Agents in virtual time: a line in, a line out
 * ============================================================================================================= */

typedef struct { Agent *a; Json json; Buf bytes, out; } Virtual;

static bool virtual_error(Virtual *v, const char *error, bool unsupported) {
    put_format(&v->out, "{\"error\":\"%s\"%s}", error, unsupported ? ",\"unsupported\":true" : "");
    return false;
}

/* The store's value is the file that would be left, in base64, with all that is there in place of how it came. */
static void put_store(Buf *b, Agent *a) {
    const List *lists[] = {&a->chain, &a->deque, &a->stack};
    const enum change changes[] = {CHAIN_PUSH, DEQUE_PUSH, STACK_PUSH};
    Buf file = {0};
    put_store_header(&file, a);
    for (size_t i = 0; i < completed_len(a); i++) {
        put_byte(&file, COMPLETE);
        put(&file, a->completed.data + 32 * i, 32);
    }
    for (int k = 0; k < 3; k++)
        for (size_t i = 0; i < lists[k]->len; i++)
            put_journal(&file, changes[k], lists[k]->at[i]);
    if (a->keys != NULL)
        put_keys_store(&file, a);
    put_byte(b, '"');
    put_base64(b, file.data, file.len);
    put_byte(b, '"');
    free(file.data);
}

static bool virtual_store(Virtual *v, uint32_t value) { /* into an agent that is new */
    Buf header = {0}, *file = &v->bytes;
    put_store_header(&header, v->a);
    v->a->boots = json_bytes(&v->json, value, file) && file->len >= header.len
               && memcmp(file->data, header.data, header.len) == 0
               && store_replay(v->a, file->data + header.len, file->data + file->len);
    free(header.data);
    return v->a->boots;
}

/* The driver takes the part of disk and chance: it gives the bundle, and says which life this is. */
static bool virtual_keys(Virtual *v, Fault *fault) {
    Json *j = &v->json;
    uint8_t life[BOOT];
    size_t n;
    uint32_t boot = member(j, ROOT, "boot");
    const char *text = kind(j, boot) == '"' ? json_text(j, boot, &n) : NULL;
    if (text == NULL || n != 2 * BOOT) return fail(fault, STATUS_WRONG, "A secured mission takes a bundle and a boot.");
    for (size_t i = 0; i < BOOT; i++) {
        int high = hex_digit(text[2 * i]), low = hex_digit(text[2 * i + 1]);
        if (high < 0 || low < 0) return fail(fault, STATUS_WRONG, "boot is not hexadecimal.");
        life[i] = (uint8_t)(high << 4 | low);
    }
    return keys_read(v->a, j, member(j, ROOT, "bundle"), life, fault);
}

static bool virtual_mission(Virtual *v, double t, uint32_t mission) {
    Agent *a = v->a;
    Json *j = &v->json;
    Fault fault;
    uint32_t trace = member(j, ROOT, "trace"), store = member(j, ROOT, "store");
    a->started = false;                                 /* whatever comes of it, the agent that was is gone */
    if (!mission_read(&a->m, j, mission, &fault)) return virtual_error(v, fault.text, fault.status == STATUS_LACKS);
    if (!a->m.has_epoch || a->m.speedup != 1 || a->m.random_events || a->m.store != NULL
        || (trace != 0 && kind(j, trace) != 't' && kind(j, trace) != 'f'))
        return virtual_error(v, "This is no mission in virtual time.", false);
    agent_new(a);
    if (a->m.bundle != NULL && !virtual_keys(v, &fault))
        return virtual_error(v, fault.text, fault.status == STATUS_LACKS);
    if (store != 0 && kind(j, store) != 'n' && !virtual_store(v, store))
        return virtual_error(v, "The store is none of this agent and this mission.", false);
    a->started = true;
    a->tracing = kind(j, trace) != 'f';
    a->now = t;
    if (a->boots)
        boot(a, t);
    return true;
}

static void virtual_command(Virtual *v, double t, uint32_t command, Buf *b) {
    Agent *a = v->a;
    Json *j = &v->json;
    a->now = t;
    if (says(j, command, "status")) {
        put_status(b, a, t, NULL);
    } else if (says(j, command, "store")) {
        put_text(b, "{\"ok\":true,\"store\":");
        put_store(b, a);
        put_byte(b, '}');
    } else if (says(j, command, "export")) {
        note_command(a, t, j, ROOT, "export", "t");
        put_export(b, a, timestamp_at(a, t));
    } else if (says(j, command, "stop_events")) {
        a->no_events = true;
        note_command(a, t, j, ROOT, "stop_events", "t");
        put_text(b, "{\"ok\":true}");
    } else if (says(j, command, "reconcile")) {
        take_reconcile(a, t);
        put_text(b, "{\"ok\":true}");
    } else if (a->keys != NULL && says(j, command, "revoke")) {
        Buf body = {0};
        const char *error = !json_bytes(j, member(j, ROOT, "revocation"), &body) ? "This is no revocation."
                          : take_revocation(a, t, body.data, body.len);
        free(body.data);
        if (error != NULL)
            put_error(b, false, error);
        else
            put_text(b, "{\"ok\":true}");
    } else {
        put_error(b, true, "This agent does not have the command.");
    }
}

/* One input; false: the output is an error. */
static bool virtual_input(Virtual *v, const char *line, size_t n) {
    Agent *a = v->a;
    Json *j = &v->json;
    double t;
    uint32_t at;
    uint64_t id, timestamp;
    v->bytes.len = 0;                                   /* holds a command's answer at the end */
    if (!json_parse(j, line, n) || kind(j, ROOT) != '{' || !json_double(j, member(j, ROOT, "t"), &t))
        return virtual_error(v, "This line is no input with a time.", false);
    if ((at = member(j, ROOT, "mission")) != 0) {
        bool good = virtual_mission(v, t, at);
        v->bytes.len = 0;
        return good;
    }
    if (!a->started) return virtual_error(v, "There is no mission yet.", false);
    if (t < a->now) return virtual_error(v, "Time never goes back.", false);
    if ((at = member(j, ROOT, "datagram")) != 0) {
        if (!json_bytes(j, at, &v->bytes)) return virtual_error(v, "The datagram is no base64.", false);
        take_datagram(a, t, v->bytes.data, v->bytes.len);
        v->bytes.len = 0;
    } else if (kind(j, member(j, ROOT, "timer")) == 't') {
        take_timers(a, t);
    } else if ((at = member(j, ROOT, "event_id")) != 0) {
        if (!json_uint(j, at, 1, 254, &id) || !json_bytes(j, member(j, ROOT, "data"), &v->bytes)
            || !json_uint(j, member(j, ROOT, "timestamp_us"), 0, INT64_MAX, &timestamp)
            || !event_fits(a, v->bytes.len))
            return virtual_error(v, "This is no event, or it is too large.", false);
        take_event(a, t, (uint8_t)id, timestamp, v->bytes.data, v->bytes.len);
        v->bytes.len = 0;
    } else if ((at = member(j, ROOT, "command")) != 0) {
        virtual_command(v, t, at, &v->bytes);
    } else {
        return virtual_error(v, "This line is no input that this agent knows.", false);
    }
    return true;
}

static void virtual_output(Virtual *v) {                /* what the input did, and the answer if it was a command */
    Agent *a = v->a;
    Buf *out = &v->out;
    hold_answers(a);
    double timer = next_deadline(a);
    put_text(out, "{\"sent\":[");
    for (size_t at = 0; at < a->out.len;) {
        size_t n = (size_t)read_be(a->out.data + at, 2);
        put_text(out, at > 0 ? ",\"" : "\"");
        put_base64(out, a->out.data + at + 2, n);
        put_byte(out, '"');
        a->bytes_sent += n;
        at += 2 + n;
    }
    if (isfinite(timer))
        put_format(out, "],\"timer\":%.17g", timer);
    else
        put_text(out, "],\"timer\":null");
    if (a->tracing) {
        put_text(out, ",\"trace\":[");
        for (size_t i = 0; i + 1 < a->lines.len; i++)   /* a line has its only newline at the end */
            if (a->lines.data[i] == '\n')
                a->lines.data[i] = ',';
        put(out, a->lines.data, a->lines.len - (a->lines.len > 0));
        put_byte(out, ']');
    }
    if (v->bytes.len > 0) {
        put_text(out, ",\"answer\":");
        put(out, v->bytes.data, v->bytes.len);
    }
    put_byte(out, '}');
    a->out.len = a->lines.len = 0;
}

static int play_in_virtual_time(Agent *a) {
    static Virtual virtual;
    Virtual *v = &virtual;
    Buf in = {0};
    bool too_long = false;
    v->a = a;
    for (;;) {
        ssize_t n = read(STDIN_FILENO, buf_room(&in, 1 << 16), 1 << 16);
        if (n < 0 && errno == EINTR) continue;
        if (n <= 0) break;
        size_t from = in.len, at = 0;
        in.len += (size_t)n;
        for (uint8_t *end; (end = memchr(in.data + from, '\n', in.len - from)) != NULL; from = at) {
            *end = '\0';
            if (too_long)
                virtual_error(v, "The line is too long.", false);
            else if (virtual_input(v, (char *)in.data + at, (size_t)(end - in.data) - at))
                virtual_output(v);
            too_long = false;
            put_byte(&v->out, '\n');
            at = (size_t)(end - in.data) + 1;
        }
        buf_drop(&in, at);
        if (v->out.len > 0 && !write_all(STDOUT_FILENO, v->out.data, v->out.len))
            break;                                      /* nobody listens any more */
        v->out.len = 0;
        if (in.len > MAX_VIRTUAL) {
            too_long = true;
            in.len = 0;
        }
    }
    free(in.data);
    free(v->bytes.data);
    free(v->out.data);
    free(v->json.node);
    free(v->json.scratch.data);
    return 0;
}

/* ================================================================================================================ */

static void agent_free(Agent *a) {
    list_clear(&a->chain);
    list_clear(&a->deque);
    list_clear(&a->stack);
    void *const all[] = {a->chain.at, a->deque.at, a->stack.at, a->completed.data, a->candidates, a->out.data,
                         a->waiting.data,
                         a->lines.data, a->journal.data, a->body.data, a->changes.data, a->sent.data, a->m.roster,
                         a->m.initial_data.data, a->m.store, a->m.bundle, a->sealed.data};
    keys_free(a);
    for (size_t i = 0; i < sizeof all / sizeof *all; i++)
        free(all[i]);
}

int main(int argc, char **argv) {
    static Agent agent;
    if (argc != 2) {
        fprintf(stderr, "usage: %s MISSION_FILE | --virtual\n", argv[0]);
        return STATUS_WRONG;
    }
    int status = strcmp(argv[1], "--virtual") == 0 ? play_in_virtual_time(&agent) : play_over_udp(&agent, argv[1]);
    agent_free(&agent);
    return status;
}
