#include "board.h"

#include <simavr/avr_adc.h>
#include <simavr/avr_extint.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_time.h>
#include <simavr/sim_vcd_file.h>
#include <stdlib.h>
#include <string.h>

#define FREQUENCY 16000000UL
#define DIVIDER (10000.0 / (33000.0 + 10000.0)) /* as in the firmware's settings */
#define SAG 0.02                                /* of the supply where all fans draw their most */
#define QUEUE 8192
#define COUNTERS_BYTES 24 /* of counters.h */

/* Registers of the ATmega328P, as addresses of data. */
enum { DDRB = 0x24, PORTB = 0x25, DDRD = 0x2A, PORTD = 0x2B, TCCR0A = 0x44, OCR0A = 0x47, OCR0B = 0x48 };
enum { TCCR1A = 0x80, ICR1L = 0x86, OCR1AL = 0x88, OCR1BL = 0x8A, TCCR2A = 0xB0, OCR2A = 0xB3, OCR2B = 0xB4 };

typedef struct {
    uint16_t control, compare, top; /* registers of the timer */
    uint8_t connected;              /* bit of the control register: the timer drives the pin */
    uint8_t bytes;
    uint16_t direction, port; /* registers of the pin */
    uint8_t bit;
    char port_name;
} channel_t;

static const uint16_t CLOCK_OF[BOARD_FANS] = {0x81, 0x81, 0xB1, 0x45}; /* TCCR1B, TCCR1B, TCCR2B, TCCR0B */

static const channel_t CHANNELS[BOARD_FANS] = {
    {TCCR1A, OCR1AL, ICR1L, 0x80, 2, DDRB, PORTB, 1, 'B'},
    {TCCR1A, OCR1BL, ICR1L, 0x20, 2, DDRB, PORTB, 2, 'B'},
    {TCCR2A, OCR2B, OCR2A, 0x20, 1, DDRD, PORTD, 3, 'D'},
    {TCCR0A, OCR0B, OCR0A, 0x20, 1, DDRD, PORTD, 5, 'D'},
};

typedef struct {
    int number;
    rotor_t rotor;
    avr_irq_t *tacho;
    bool level, is_inverted_by_noise;
    int noise_us, edges, next_edge;
    avr_cycle_count_t at[ROTOR_EDGES];
    bool to[ROTOR_EDGES];
    uint32_t pulses, pwm_periods;
} fan_state_t;

void (*board_on_byte)(uint8_t byte);

static avr_t *avr;
static elf_firmware_t firmware;
static avr_vcd_t trace;
static avr_irq_t *shown; /* in the trace: duty of each fan in thousandths, and whether it is blocked */
static fan_state_t fans[BOARD_FANS];
static double supply_v = 12.0;
static avr_run_t run_instructions;
static avr_cycle_count_t step_end;
static unsigned restarts;
static uint32_t noise_seed = 1;
static uint16_t queue[QUEUE];
static unsigned queue_from, queue_length;

static uint16_t value_of(const channel_t *channel, uint16_t address)
{
    return avr->data[address] | (channel->bytes == 2 ? avr->data[address + 1] << 8 : 0);
}

/* From the registers, as the data sheet says: simavr 1.6 does not move the pins of timer 1 with its compare values. */
static double duty_of(int fan)
{
    const channel_t *channel = &CHANNELS[fan];
    if (!(avr->data[channel->direction] >> channel->bit & 1))
        return 1.0; /* an open input of the fan is pulled up there: full speed */
    if (!(avr->data[channel->control] & channel->connected))
        return avr->data[channel->port] >> channel->bit & 1;
    return (value_of(channel, channel->compare) + 1.0) / (value_of(channel, channel->top) + 1.0);
}

/* 0 where the timer does not run. */
static double pwm_hz_of(int fan)
{
    static const int divisors[] = {0, 1, 8};
    unsigned selected = avr->data[CLOCK_OF[fan]] & 7;
    if (selected < 1 || selected > 2) /* those that have 25 kHz, alike in all timers */
        return 0.0;
    return (double)FREQUENCY / divisors[selected] / (value_of(&CHANNELS[fan], CHANNELS[fan].top) + 1.0);
}

static void show_level(fan_state_t *fan)
{
    avr_raise_irq(fan->tacho, fan->level != fan->is_inverted_by_noise);
}

static avr_cycle_count_t at_edge(avr_t *mcu, avr_cycle_count_t when, void *parameter)
{
    (void)when;
    fan_state_t *fan = parameter;
    while (fan->next_edge < fan->edges && fan->at[fan->next_edge] <= mcu->cycle) {
        fan->level = fan->to[fan->next_edge++];
        fan->pulses += !fan->level;
        show_level(fan);
    }
    return fan->next_edge < fan->edges ? fan->at[fan->next_edge] : 0;
}

static avr_cycle_count_t at_noise(avr_t *mcu, avr_cycle_count_t when, void *parameter)
{
    fan_state_t *fan = parameter;
    fan->is_inverted_by_noise = !fan->is_inverted_by_noise;
    show_level(fan);
    (void)mcu;
    return fan->is_inverted_by_noise ? when + avr_usec_to_cycles(mcu, fan->noise_us) : 0;
}

static void turn(fan_state_t *fan, double at_fans_v)
{
    double shares[ROTOR_EDGES];
    avr_cycle_count_t step = avr_usec_to_cycles(avr, STEP_US), begin = step_end - step;
    at_edge(avr, 0, fan); /* one at the very end of the step before */
    fan->edges = rotor_turn(&fan->rotor, duty_of(fan->number), at_fans_v, STEP_US * 1e-6, shares, fan->to);
    fan->next_edge = 0;
    for (int i = 0; i < fan->edges; i++)
        fan->at[i] = begin + (avr_cycle_count_t)(shares[i] * step);
    if (fan->edges > 0)
        avr_cycle_timer_register(avr, fan->at[0] > avr->cycle ? fan->at[0] - avr->cycle : 1, at_edge, fan);
    if (fan->noise_us > 0 && !fan->is_inverted_by_noise) {
        noise_seed = noise_seed * 1664525u + 1013904223u;
        avr_cycle_timer_register(avr, 1 + (noise_seed >> 8) % (step / 2), at_noise, fan);
    }
}

static double at_fans_v(void)
{
    double drawn = 0.0;
    for (int fan = 0; fan < BOARD_FANS; fan++)
        drawn += fans[fan].rotor.current_v / 12.0 / BOARD_FANS;
    return supply_v * (1.0 - SAG * drawn);
}

static avr_cycle_count_t next_byte(avr_t *mcu, avr_cycle_count_t when, void *parameter)
{
    (void)parameter;
    if (queue_length == 0)
        return 0;
    uint16_t value = queue[queue_from];
    queue_from = (queue_from + 1) % QUEUE;
    queue_length--;
    avr_raise_irq(avr_io_getirq(mcu, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT), value);
    return when + FREQUENCY / 115200 * 11; /* simavr 1.6 counts 11 bits a byte */
}

bool board_send(uint8_t byte, bool with_framing_error)
{
    if (queue_length == QUEUE)
        return false;
    queue[(queue_from + queue_length++) % QUEUE] = byte | (with_framing_error ? UART_INPUT_FE : 0);
    if (avr_cycle_timer_status(avr, next_byte, NULL) == 0)
        avr_cycle_timer_register(avr, 1, next_byte, NULL);
    return true;
}

static void take_byte(avr_irq_t *irq, uint32_t value, void *parameter)
{
    (void)irq, (void)parameter;
    if (board_on_byte)
        board_on_byte(value);
}

static void count_period(avr_irq_t *irq, uint32_t value, void *parameter)
{
    if (value && !irq->value)
        ((fan_state_t *)parameter)->pwm_periods++;
}

static void no_sleep(avr_t *mcu, avr_cycle_count_t how_long)
{
    (void)mcu, (void)how_long; /* the step paces, not each sleep of the firmware */
}

static void log_errors(avr_t *mcu, const int level, const char *format, va_list arguments)
{
    (void)mcu;
    if (level <= LOG_ERROR)
        vfprintf(stderr, format, arguments);
}

/* Nobody uses them, and simavr would look at PD3, a PWM output, with each instruction. */
static void ignore_external_interrupts(void)
{
    for (int i = 0; i < 2; i++)
        avr_extint_set_strict_lvl_trig(avr, i, 0);
}

static void start_trace(const char *path)
{
    static const char *names[2 * BOARD_FANS] = {"duty0", "duty1", "duty2", "duty3",
                                                "blocked0", "blocked1", "blocked2", "blocked3"};
    avr_vcd_init(avr, path, &trace, 10000);
    shown = avr_alloc_irq(&avr->irq_pool, 0, 2 * BOARD_FANS, names);
    for (int fan = 0; fan < BOARD_FANS; fan++) {
        char name[] = {'t', 'a', 'c', 'h', 'o', '0' + fan, 0};
        avr_vcd_add_signal(&trace, fans[fan].tacho, 1, name);
        avr_vcd_add_signal(&trace, shown + fan, 10, names[fan]);
        avr_vcd_add_signal(&trace, shown + BOARD_FANS + fan, 1, names[BOARD_FANS + fan]);
        for (int i = fan; i < 2 * BOARD_FANS; i += BOARD_FANS)
            shown[i].flags |= IRQ_FLAG_FILTERED;
    }
    if (avr_vcd_start(&trace) != 0)
        exit(1);
}

void board_start(const char *elf, const char *vcd)
{
    avr_global_logger_set(log_errors);
    if (elf_read_firmware(elf, &firmware) != 0) {
        fprintf(stderr, "simulator: %s cannot be read\n", elf);
        exit(1);
    }
    avr = avr_make_mcu_by_name("atmega328p");
    avr_init(avr);
    avr_load_firmware(avr, &firmware);
    avr->frequency = FREQUENCY;
    avr->sleep = no_sleep;
    avr->log = LOG_ERROR;
    run_instructions = avr->run;
    ignore_external_interrupts();
    board_set_chip_supply(5.0);
    uint32_t flags = 0; /* no echo to standard output, no sleep while it polls */
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), take_byte, NULL);
    for (int i = 0; i < BOARD_FANS; i++) {
        fan_state_t *fan = &fans[i];
        *fan = (fan_state_t){.number = i, .rotor = rotor_at_rest(i)};
        fan->tacho = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('C'), i);
        fan->level = rotor_level(&fan->rotor);
        show_level(fan);
        avr_irq_register_notify(
            avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(CHANNELS[i].port_name), CHANNELS[i].bit), count_period, fan);
    }
    if (vcd)
        start_trace(vcd);
}

/* simavr has taken away the levels of the pins and all timers, ours too. The count of cycles goes on, and the trace,
 * which is then written whenever its buffer is full. */
static void after_restart(void)
{
    restarts++;
    ignore_external_interrupts();
    for (int i = 0; i < BOARD_FANS; i++) {
        fan_state_t *fan = &fans[i];
        fan->is_inverted_by_noise = false;
        avr_raise_irq(fan->tacho, !fan->level);
        show_level(fan);
        if (fan->next_edge < fan->edges)
            avr_cycle_timer_register(avr, 1, at_edge, fan);
    }
    if (queue_length > 0)
        avr_cycle_timer_register(avr, 1, next_byte, NULL);
}

/* So that the firmware does not sleep over the end of a step. */
static avr_cycle_count_t at_end_of_step(avr_t *mcu, avr_cycle_count_t when, void *parameter)
{
    (void)mcu, (void)when, (void)parameter;
    return 0;
}

void board_step(void)
{
    double volts = at_fans_v();
    step_end += avr_usec_to_cycles(avr, STEP_US);
    avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_ADC4), (uint32_t)(volts * DIVIDER * 1000.0 + 0.5));
    for (int i = 0; i < BOARD_FANS; i++) {
        turn(&fans[i], volts);
        if (trace.output) {
            avr_raise_irq(shown + i, (uint32_t)(duty_of(i) * 1000.0 + 0.5));
            avr_raise_irq(shown + BOARD_FANS + i, fans[i].rotor.is_blocked);
        }
    }
    avr_cycle_timer_register(avr, step_end - avr->cycle, at_end_of_step, NULL);
    while (avr->cycle < step_end) {
        bool restarts_now = avr->run != run_instructions; /* the watchdog sets another one, for one call */
        int state = avr_run(avr);
        if (state == cpu_Done || state == cpu_Crashed) {
            fprintf(stderr, "simulator: the firmware has %s\n", state == cpu_Done ? "ended" : "crashed");
            exit(1);
        }
        if (restarts_now)
            after_restart();
    }
}

double board_time_s(void)
{
    return (double)avr->cycle / FREQUENCY;
}

rotor_t *board_rotor(int fan)
{
    return &fans[fan].rotor;
}

void board_set_supply(double volts)
{
    supply_v = volts;
}

void board_set_chip_supply(double volts)
{
    avr->vcc = avr->avcc = (uint32_t)(volts * 1000.0 + 0.5);
}

void board_set_noise(int fan, int length_us)
{
    fans[fan].noise_us = length_us;
}

void board_hang(void)
{
    /* `rjmp .` at the end of the flash, and interrupts off */
    avr->flash[avr->flashend - 1] = 0xFF;
    avr->flash[avr->flashend] = 0xCF;
    avr->pc = avr->flashend - 1;
    avr->sreg[S_I] = 0;
    avr->state = cpu_Running;
}

static void print_counters(FILE *to)
{
    for (uint32_t i = 0; i < firmware.symbolcount; i++) {
        if (strcmp(firmware.symbol[i]->symbol, "counters") != 0)
            continue;
        const uint8_t *at = avr->data + (firmware.symbol[i]->addr & 0xFFFF);
        for (int byte = 0; byte < COUNTERS_BYTES; byte++)
            fprintf(to, "%02x", at[byte]);
        return;
    }
}

void board_print_state(FILE *to)
{
    fprintf(to, "{\"t_s\": %.6f, \"restarts\": %u, \"supply_v\": %.4f, \"fans\": [", board_time_s(), restarts,
            at_fans_v());
    for (int i = 0; i < BOARD_FANS; i++)
        fprintf(to, "%s{\"speed_rad_s\": %.5f, \"duty\": %.5f, \"pulses\": %u, \"pwm_hz\": %.1f, \"pwm_periods\": %u}",
                i ? ", " : "", fans[i].rotor.speed_rad_s, duty_of(i), fans[i].pulses, pwm_hz_of(i),
                fans[i].pwm_periods);
    fprintf(to, "], \"counters\": \"");
    print_counters(to);
    fprintf(to, "\"}\n");
    fflush(to);
}

void board_end(void)
{
    if (trace.output)
        avr_vcd_stop(&trace);
}
