/* Four simulated fans on the firmware in simavr, driven by lines on standard input.
 *
 *   simulator FIRMWARE.elf                       lock-step: time passes with `run SECONDS` only, as fast as it can
 *   simulator FIRMWARE.elf --link /tmp/board     real time: the serial line is a pseudo-terminal behind this link
 *     --vcd FILE          trace of the pins: tachos, duties in thousandths, what is blocked
 *     --at SECONDS LINE   a line at a simulated time, repeatable
 *
 * Lines: run S, send HEX, send-broken HEX (framing errors), block FAN, free FAN, drag FAN FACTOR, hold FAN RPM (turned
 * from outside), release FAN, supply V, chip-supply V, noise FAN US, hang, state, quit. Each is answered by `ok` or
 * `error ...`; before that come the bytes that were sent (`sent HEX`) and what was asked for. */
#include <ctype.h>
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <poll.h>
#include <pty.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "board.h"

#define LINE_BYTES 4096
#define AT_MOST 16
#define SAY_BEHIND_S 0.25

typedef struct {
    double at_s;
    const char *line;
} scheduled_t;

static scheduled_t scheduled[AT_MOST];
static int scheduled_count;
static volatile sig_atomic_t is_stopped;
static const char *link_path;
static int terminal = -1;
static bool has_reader;
static uint8_t sent[1 << 20];
static size_t sent_length;
static double furthest_behind_s;

static void stop(int number)
{
    (void)number;
    is_stopped = 1;
}

static void keep_byte(uint8_t byte)
{
    if (sent_length < sizeof sent)
        sent[sent_length++] = byte;
}

static void print_sent(void)
{
    if (sent_length == 0)
        return;
    fputs("sent ", stdout);
    for (size_t i = 0; i < sent_length; i++)
        printf("%02x", sent[i]);
    putchar('\n');
    sent_length = 0;
}

static void run_scheduled(void);

static void run_for(double seconds)
{
    for (long steps = lround(seconds * 1e6 / STEP_US); steps > 0 && !is_stopped; steps--) {
        run_scheduled();
        board_step();
    }
}

static bool send_hex(const char *hex, bool is_broken)
{
    unsigned byte;
    for (; isxdigit((unsigned char)hex[0]) && sscanf(hex, "%2x", &byte) == 1; hex += 2)
        if (!board_send(byte, is_broken))
            return false;
    return true;
}

/* Do what a line says; returns whether it was understood. */
static bool obey(const char *line)
{
    char word[16], rest[LINE_BYTES] = "";
    if (sscanf(line, "%15s %4095[^\n]", word, rest) < 1)
        return true;
    double value = atof(rest), second = strchr(rest, ' ') ? atof(strchr(rest, ' ')) : 0.0;
    int fan = (int)value;
    bool is_fan = isdigit((unsigned char)rest[0]) && fan < BOARD_FANS;
    if (strcmp(word, "quit") == 0)
        is_stopped = 1;
    else if (strcmp(word, "run") == 0 && !link_path)
        run_for(value);
    else if (strcmp(word, "send") == 0)
        return send_hex(rest, false);
    else if (strcmp(word, "send-broken") == 0)
        return send_hex(rest, true);
    else if (strcmp(word, "supply") == 0)
        board_set_supply(value);
    else if (strcmp(word, "chip-supply") == 0)
        board_set_chip_supply(value);
    else if (strcmp(word, "hang") == 0)
        board_hang();
    else if (strcmp(word, "state") == 0)
        board_print_state(stdout);
    else if (!is_fan)
        return false;
    else if (strcmp(word, "block") == 0)
        board_rotor(fan)->is_blocked = true;
    else if (strcmp(word, "free") == 0)
        board_rotor(fan)->is_blocked = false;
    else if (strcmp(word, "drag") == 0)
        board_rotor(fan)->drag_factor = second;
    else if (strcmp(word, "hold") == 0)
        board_rotor(fan)->held_rad_s = second * 2.0 * M_PI / 60.0;
    else if (strcmp(word, "release") == 0)
        board_rotor(fan)->held_rad_s = -1.0;
    else if (strcmp(word, "noise") == 0)
        board_set_noise(fan, (int)second);
    else
        return false;
    return true;
}

static void run_scheduled(void)
{
    for (int i = 0; i < scheduled_count; i++) {
        if (!scheduled[i].line || board_time_s() < scheduled[i].at_s)
            continue;
        fprintf(stderr, "simulator: at %.3f s: %s\n", board_time_s(), scheduled[i].line);
        if (!obey(scheduled[i].line)) {
            fprintf(stderr, "simulator: this line is not understood\n");
            exit(2);
        }
        scheduled[i].line = NULL;
    }
}

static void answer(const char *line)
{
    bool is_understood = obey(line);
    print_sent();
    if (is_understood)
        puts("ok");
    else
        printf("error %s\n", line);
    fflush(stdout);
}

static void in_lock_step(void)
{
    char line[LINE_BYTES];
    if (isatty(STDIN_FILENO))
        fputs("simulator: ready, in lock-step: give lines such as run 0.5 (seconds); --link PATH runs in real time\n",
              stderr);
    while (!is_stopped && fgets(line, sizeof line, stdin)) {
        line[strcspn(line, "\n")] = 0;
        answer(line);
    }
}

static double now_s(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec + now.tv_nsec * 1e-9;
}

static void open_terminal(void)
{
    int other;
    struct termios settings;
    if (openpty(&terminal, &other, NULL, NULL, NULL) != 0) {
        perror("simulator: openpty");
        exit(1);
    }
    tcgetattr(other, &settings);
    cfmakeraw(&settings);
    tcsetattr(other, TCSANOW, &settings);
    unlink(link_path);
    if (symlink(ttyname(other), link_path) != 0) {
        perror("simulator: --link");
        exit(1);
    }
    close(other); /* so that it shows whether somebody reads */
    fcntl(terminal, F_SETFL, O_NONBLOCK);
    fcntl(STDIN_FILENO, F_SETFL, O_NONBLOCK);
}

/* The serial line as a cable: what nobody reads is gone. */
static void exchange(void)
{
    struct pollfd state = {.fd = terminal, .events = POLLIN};
    poll(&state, 1, 0);
    has_reader = !(state.revents & POLLHUP);
    if (has_reader) {
        uint8_t bytes[256];
        ssize_t length = read(terminal, bytes, sizeof bytes);
        for (ssize_t i = 0; i < length; i++)
            board_send(bytes[i], false);
        if (sent_length > 0 && write(terminal, sent, sent_length) < 0 && errno != EAGAIN)
            perror("simulator: write");
    }
    sent_length = 0;
}

/* Lines that have come on standard input; its end is no end, so that it may run without one. */
static void take_lines(void)
{
    static char line[LINE_BYTES];
    static size_t length;
    char byte;
    while (read(STDIN_FILENO, &byte, 1) == 1) {
        if (byte != '\n') {
            if (length < sizeof line - 1)
                line[length++] = byte;
            continue;
        }
        line[length] = 0;
        length = 0;
        answer(line);
    }
}

static void in_real_time(void)
{
    open_terminal();
    fprintf(stderr, "simulator: ready: the serial line of the board is %s; settings and faults on standard input\n",
            link_path);
    double began_s = now_s();
    bool was_behind = false;
    while (!is_stopped) {
        run_scheduled();
        board_step();
        exchange();
        take_lines();
        double ahead_s = board_time_s() - (now_s() - began_s);
        if (ahead_s > 0.0)
            usleep(ahead_s * 1e6);
        furthest_behind_s = fmax(furthest_behind_s, -ahead_s);
        bool is_behind = ahead_s < (was_behind ? 0.0 : -SAY_BEHIND_S);
        if (is_behind != was_behind)
            fprintf(stderr, "simulator: at %.1f s: %s\n", board_time_s(),
                    is_behind ? "behind real time, this machine is too busy" : "in real time again");
        was_behind = is_behind;
    }
    fprintf(stderr, "simulator: %.1f s, at most %.3f s behind real time\n", board_time_s(), furthest_behind_s);
    unlink(link_path);
}

int main(int count, char **words)
{
    const char *vcd = NULL;
    for (int i = 2; i < count; i++) {
        if (strcmp(words[i], "--link") == 0 && i + 1 < count)
            link_path = words[++i];
        else if (strcmp(words[i], "--vcd") == 0 && i + 1 < count)
            vcd = words[++i];
        else if (strcmp(words[i], "--at") == 0 && i + 2 < count && scheduled_count < AT_MOST) {
            scheduled[scheduled_count].at_s = atof(words[++i]);
            scheduled[scheduled_count++].line = words[++i];
        } else
            count = 0;
    }
    if (count < 2) {
        fprintf(stderr, "usage: %s FIRMWARE.elf [--link PATH] [--vcd FILE] [--at SECONDS LINE]...\n", words[0]);
        return 2;
    }
    signal(SIGINT, stop);
    signal(SIGTERM, stop);
    board_on_byte = keep_byte;
    board_start(words[1], vcd);
    if (link_path)
        in_real_time();
    else
        in_lock_step();
    board_end();
    return 0;
}
